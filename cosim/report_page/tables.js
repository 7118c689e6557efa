// Words and tables: headline, runs, phases, settings.

const OUTCOMES = { success: "good", exit: "bad", collision: "bad", timeout: "warn", "cut short": "warn" };
const WORDS = {
  success: "Success",
  exit: "Left the tube",
  collision: "Collision",
  timeout: "Time-out",
  "cut short": "Cut short",
};

function chip(outcome) {
  return make("span", { class: `chip ${OUTCOMES[outcome] ?? ""}` }, WORDS[outcome] ?? outcome);
}

function percent(share, digits = 1) {
  return share === null || share === undefined ? "–" : `${(100 * share).toFixed(digits)} %`;
}

/** The top of the page for one run. */
function headlineOf(run, onSeek) {
  const figure = (name, value, title = null, onclick = null) =>
    make(
      "div",
      { title },
      make("dt", {}, name),
      make("dd", {}, onclick ? make("button", { type: "button", class: "link", onclick }, value) : value),
    );
  const made = percent(run.progress);
  return [
    make("p", { class: "kicker" }, "cosim report"),
    make("h1", {}, run.tube_name, make("span", {}, ` flown by ${run.policy}`)),
    make(
      "p",
      { class: "lead" },
      chip(run.outcome),
      ` after ${run.steps.toLocaleString("en")} control steps, ${run.sim_time.toFixed(1)} s of flight, ${made} of ${say(run.length)} m.`,
    ),
    make(
      "dl",
      { class: "figures" },
      figure("progress", made),
      figure("quality Q", fixed(run.quality, 3), "centring and alignment, 0 to 1"),
      figure("smallest gap", `${fixed(run.gap, 3)} m`, "between body and wall; shows the moment", () =>
        onSeek(run.gap_time),
      ),
      figure("steps with contact", `${run.contacts}`),
      figure(
        "loop",
        run.steps_per_second ? `${Math.round(run.steps_per_second).toLocaleString("en")} /s` : "–",
        "control steps a second of real time",
      ),
      figure("seed", `${run.seed}`),
    ),
    ...notesOf([run]),
  ];
}

/** What on the page is not as it was flown or recorded. */
function notesOf(runs) {
  return runs.flatMap((run) =>
    [
      ...run.notes,
      ...(run.stride > 1 ? [`one of ${run.stride} of its ${run.records.toLocaleString("en")} records is shown`] : []),
    ].map((note) => make("p", { class: "note" }, runs.length > 1 ? `${run.name}: ${note}` : note)),
  );
}

function thinnedNotes(data) {
  return data.tubes
    .filter((tube) => tube.triangles < tube.triangles_flown)
    .map((tube) =>
      make(
        "p",
        { class: "note" },
        `the tube is drawn with ${tube.triangles.toLocaleString("en")} of its ${tube.triangles_flown.toLocaleString("en")} triangles`,
      ),
    );
}

/** The table of several runs, which is the legend as well: a tick shows a run, its name brings it into focus. */
function runsTable(runs, onFocus, onVisible) {
  const head = ["", "run", "outcome", "pilot", "tube", ">steps", ">progress", ">Q", ">smallest gap", ">contact"];
  const rows = runs.map((run) => {
    const tick = make("input", {
      type: "checkbox",
      "aria-label": `show ${run.label}`,
      onchange: () => onVisible(run, tick.checked),
    });
    return make(
      "tr",
      { "data-run": run.number },
      make("td", { style: `--key:${runColour(run)}` }, tick, make("i", { class: "swatch" })),
      make(
        "td",
        {},
        make(
          "a",
          {
            href: `#run=${run.number}`,
            onclick: (event) => {
              event.preventDefault();
              onFocus(run);
            },
          },
          run.label,
        ),
      ),
      make("td", {}, chip(run.outcome)),
      ...[run.policy, run.tube_name].map((text) => make("td", {}, text)),
      ...[run.steps, percent(run.progress), fixed(run.quality, 3), `${fixed(run.gap, 3)} m`, run.contacts].map((text) =>
        make("td", { class: "number" }, `${text}`),
      ),
    );
  });
  return table(head, rows);
}

/** A table, which scrolls by itself where it is too wide; columns whose head begins with ">" are right-aligned. */
function table(head, rows) {
  const cells = head.map((text) =>
    make("th", { scope: "col", class: text.startsWith(">") ? "number" : null }, text.replace(">", "")),
  );
  return make(
    "div",
    { class: "scroll", tabindex: "0" },
    make("table", {}, make("thead", {}, make("tr", {}, ...cells)), make("tbody", {}, ...rows)),
  );
}

/** A row a phase: its share, its histogram on the time axis that all share, median, 99th percentile and longest. */
function phasesOf(run) {
  const { edges, rows } = run.phases;
  if (!rows.length) return [make("p", {}, "No control step was recorded.")];
  const log = (seconds) => (100 * Math.log(seconds / edges[0])) / Math.log(edges.at(-1) / edges[0]);
  const inside = (seconds) => Math.min(Math.max(log(seconds), 0), 100);
  const decades = [];
  for (let power = Math.ceil(Math.log10(edges[0])); 10 ** power <= edges.at(-1); power++) decades.push(10 ** power);
  const body = rows.map((row) => {
    const most = Math.max(...row.counts),
      n = row.counts.length;
    const d = `M0 30${row.counts.map((count, i) => `V${(30 - 28 * Math.sqrt(count / most)).toFixed(1)}H${((100 * (i + 1)) / n).toFixed(2)}`).join("")}V30Z`;
    const mark = (seconds, kind) =>
      make("line", { x1: inside(seconds), x2: inside(seconds), y1: 0, y2: 30, class: kind });
    const histogram = make(
      "svg",
      {
        viewBox: "0 0 100 30",
        preserveAspectRatio: "none",
        role: "img",
        "aria-label": `distribution: half under ${sayTime(row.p50)}, 99 % under ${sayTime(row.p99)}`,
      },
      ...decades.map((seconds) => mark(seconds, "grid")),
      make("path", { d }),
      mark(row.p50, "p50"),
      mark(row.p99, "p99"),
    );
    const share =
      row.share === null
        ? make("span", { class: "quiet" }, "beside")
        : make("div", { class: "bar" }, make("i", { style: `width:${100 * row.share}%` }));
    return make(
      "tr",
      { class: row.name, "data-phase": row.name },
      make(
        "th",
        { scope: "row" },
        row.name === "step" ? "whole step" : row.name,
        row.text ? make("small", {}, row.text) : null,
      ),
      make(
        "td",
        { class: "share" },
        share,
        row.share === null || row.name === "step" ? null : make("small", {}, percent(row.share, 0)),
      ),
      make("td", { class: "histogram" }, histogram),
      ...Object.entries({ p50: row.p50, p99: row.p99, longest: row.max }).map(([name, seconds]) =>
        make("td", { class: "number", "data-name": name }, sayTime(seconds)),
      ),
    );
  });
  const scale = make(
    "div",
    { class: "scale-axis" },
    ...decades.map((seconds) => make("span", { style: `left:${log(seconds)}%` }, sayTime(seconds))),
  );
  const foot = make(
    "tr",
    { class: "axis" },
    make("td", {}),
    make("td", {}),
    make("td", {}, scale),
    make("td", { colspan: 3 }),
  );
  return [
    table(
      ["", "share", "distribution (logarithmic; marked: median, 99th percentile)", ">p50", ">p99", ">longest"],
      [...body, foot],
    ),
  ];
}

/** Hashes first, then all of the manifest, folded. */
function factsOf(run) {
  const m = run.manifest,
    hash = (text) => (text ? make("code", { class: "hash" }, text) : "–");
  const facts = [
    ["run folder", make("code", {}, run.folder)],
    ["flown", `${m.created}, ${m.status}`],
    ["trajectory hash", hash(run.trajectory_hash)],
    ["manifest SHA-256", hash(m.manifest_sha256)],
    ["mesh", m.mesh.path],
    ["mesh SHA-256", hash(m.mesh.sha256)],
    ["centreline SHA-256", hash(m.mesh.centreline_sha256)],
    ["policy", `${run.policy}: ${m.policy.sees}`],
    ["policy SHA-256", hash(m.policy.sha256)],
    [
      "physics",
      `${m.plant.name} ${m.plant.version}, engine ${m.plant.engine}; control step ${say(1e3 * m.session.dt, 4)} ms of ${m.session.inner_steps} inner steps`,
    ],
    [
      "versions",
      Object.entries(m.versions)
        .map(([name, version]) => `${name} ${version}`)
        .join(", "),
    ],
    ["continues", m.continues ? `${m.continues.run} after step ${m.continues.from_step}` : "–"],
    ["prove it", make("code", {}, `cosim verify ${run.folder}`)],
  ];
  const list = facts
    .filter(([, value]) => value !== "–")
    .map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value)));
  return [
    make("dl", { class: "facts" }, ...list),
    make("details", { class: "manifest" }, make("summary", {}, "Everything that the manifest says"), tree(m)),
  ];
}

/** Nested data as nested lists; what is large stays folded. */
function tree(value) {
  const entries = Object.entries(value).map(([name, part]) => {
    const simple =
      part === null ||
      typeof part !== "object" ||
      (Array.isArray(part) && part.every((item) => typeof item !== "object"));
    if (simple)
      return make(
        "div",
        {},
        make("dt", {}, name),
        make("dd", {}, part === null ? "–" : Array.isArray(part) ? part.join(", ") : `${part}`),
      );
    return make("div", { class: "nested" }, make("details", {}, make("summary", {}, name), tree(part)));
  });
  return make("dl", { class: "facts" }, ...entries);
}
