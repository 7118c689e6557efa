// An evaluation: its table beside the paper's figures, and its failures with what flies them again.

const SHOWN_FAILURES = 50;

/** The table and the failures of one evaluation. */
function evaluationOf(evaluation, runs, onFocus) {
  const setting = (row) =>
    row.setting
      ? `${row.setting} ${[].concat(row.value).join(" to ")}, `
      : row.gain !== undefined
        ? `gain ${row.gain}, compensation ${row.compensation}, `
        : "";
  const titles = [...new Set(evaluation.rows.map((row) => `${setting(row)}level ${row.level}`))];
  const rows = titles.flatMap((title) => {
    const flown = evaluation.rows.filter((row) => `${setting(row)}level ${row.level}` === title);
    const paper = evaluation.paper.filter((row) => row.level === flown[0].level);
    return [
      make("tr", { class: "group" }, make("th", { colspan: 9, scope: "rowgroup" }, title)),
      ...paper.map((row) => evaluationRow(row, `${row.policy} (paper)`, "paper")),
      ...flown.map((row) => evaluationRow(row, row.policy, "")),
    ];
  });
  const head = ["pilot", ">success", "", ">exit", ">collision", ">time-out", ">Q", ">steps", ">length"];
  return [
    make("h1", {}, "Evaluation"),
    ...evaluation.heading.map((line) => make("p", { class: "lead small" }, line)),
    table(head, rows),
    make(
      "details",
      { class: "legend-text" },
      make("summary", {}, "What the columns mean and what each pilot sees"),
      ...evaluation.legend.map((line) => make("p", {}, line)),
    ),
    ...failuresOf(evaluation, runs, onFocus),
  ];
}

function evaluationRow(row, name, kind) {
  const [low, high] = row.success_ci95.map((share) => 100 * share),
    middle = 100 * row.success;
  const bar = make(
    "div",
    {
      class: "bar",
      role: "img",
      "aria-label": `95 % interval ${low.toFixed(1)} to ${high.toFixed(1)} %`,
      title: `95 %: ${low.toFixed(1)} to ${high.toFixed(1)} %`,
    },
    make("i", { style: `width:${middle}%` }),
    make("b", { style: `left:${low}%;width:${high - low}%` }),
  );
  return make(
    "tr",
    { class: kind },
    make("td", {}, name),
    make("td", { class: "number" }, percent(row.success)),
    make("td", {}, bar),
    ...[
      percent(row.exit),
      percent(row.collision),
      percent(row.timeout),
      fixed(row.quality, 3),
      fixed(row.mean_steps, 1),
      fixed(row.length_ratio, 2),
    ].map((text) => make("td", { class: "number" }, text)),
  );
}

function failuresOf(evaluation, runs, onFocus) {
  const { failures } = evaluation;
  if (!failures.length) return [make("p", { class: "lead small" }, `None of ${evaluation.episodes} episodes failed.`)];
  const body = failures.map((failure) =>
    make(
      "tr",
      {},
      make("td", {}, replayOf(failure, runs, onFocus)),
      make("td", {}, chip(failure.outcome)),
      make("td", {}, failure.policy),
      make("td", { class: "number" }, `${failure.level}`),
      make("td", { class: "number" }, `${failure.seed}`),
      make("td", { class: "number" }, `${failure.steps}`),
      make("td", { class: "number" }, percent(failure.progress)),
      make("td", { class: "number" }, `${fixed(failure.min_clearance_m, 3)} m`),
      make("td", {}, commandOf(failure)),
    ),
  );
  const hidden = body.slice(SHOWN_FAILURES);
  hidden.forEach((row) => {
    row.hidden = true;
  });
  const more = hidden.length
    ? make(
        "button",
        {
          type: "button",
          class: "plain",
          onclick: () => {
            hidden.forEach((row) => {
              row.hidden = false;
            });
            more.remove();
          },
        },
        `Show all ${failures.length} failures`,
      )
    : null;
  const repeats = failures[0].launch_repeats ? "which repeats it bit for bit" : "in another world than the evaluation’s";
  const linked = failures.filter((failure) => failure.run !== null).length || "None";
  return [
    make("h2", {}, `Failures: ${failures.length} of ${evaluation.episodes} episodes`),
    make(
      "p",
      { class: "small" },
      `${linked} of them have their replay here. A failure is flown again by its command, ${repeats}; `,
      make("code", {}, `cosim report ${evaluation.folder} --fly ${Math.min(failures.length, SHOWN_FAILURES)}`),
      " does so and links the replays.",
    ),
    table(["replay", "outcome", "pilot", ">level", ">seed", ">steps", ">progress", ">smallest gap", "flown again by"], body),
    ...(more ? [more] : []),
  ];
}

/** The command that flies a failure again. */
function commandOf(failure) {
  const code = make("code", {}, failure.launch);
  const copy = make(
    "button",
    { type: "button", class: "plain", "aria-label": "Copy the command", onclick: () => copyText(code, copy) },
    "copy",
  );
  return make("div", { class: "command" }, copy, code);
}

/** A link to the replay of a failure where its run is on the page. */
function replayOf(failure, runs, onFocus) {
  if (failure.run === null) return "–";
  const run = runs[failure.run];
  return make(
    "a",
    {
      href: `#run=${run.number}`,
      onclick: (event) => {
        event.preventDefault();
        onFocus(run);
      },
    },
    "replay",
  );
}

/** Copy, or at least select: pages from disk may not reach the clipboard everywhere. */
function copyText(element, button) {
  getSelection().selectAllChildren(element);
  const done = navigator.clipboard?.writeText(element.textContent) ?? Promise.reject(new Error("no clipboard"));
  done.then(
    () => {
      button.textContent = "copied";
    },
    () => {
      button.textContent = document.execCommand("copy") ? "copied" : "selected";
    },
  );
}
