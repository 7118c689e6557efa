// Puts the page together; `window.cosimReport` is its handle for tests and for the curious.

const CLEARANCE_COLOURS = ["#c8102e", "#ee6c2b", "#f4b942", "#8fc1a9", "#2f9e9e", "#2b6cb0"];

/** What a path can be coloured by: value of a record, and the range that the colours span. */
const PATH_COLOURS = {
  clearance: {
    text: "gap to the wall",
    unit: "m",
    value: (run, i) => run.series.clearance[i] - run.body_radius,
    low: () => 0,
  },
  speed: { text: "speed", unit: "m/s", value: (run, i) => run.series.speed[i], low: () => 0 },
  reward: { text: "reward of a step", unit: "", value: (run, i) => rewardCurves(run)[0].values[i] },
};

/** Name each run by what tells it from the others. */
function labelRuns(runs) {
  const count = (name) => runs.filter((run) => run.name === name).length;
  for (const run of runs) run.label = count(run.name) > 1 ? run.folder : run.name;
}

function rangeOf(runs, by) {
  let low = Infinity,
    high = -Infinity;
  for (const run of runs) {
    for (let i = 0; i < run.count; i++) {
      const value = by.value(run, i);
      if (!Number.isFinite(value)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  low = by.low?.() ?? low;
  return [low, high > low ? high : low + 1];
}

/** Colours of a path, 3 a record in linear RGB; null where it has its run's own. */
function pathColours(run, by, [low, high] = [0, 1]) {
  const colours = new Float32Array(3 * run.count),
    stops = CLEARANCE_COLOURS.map((text) => new THREE.Color(text)),
    mixed = new THREE.Color();
  const own = new THREE.Color(cssColour(`--run-${run.number % 8}`));
  for (let i = 0; i < run.count; i++) {
    if (by) {
      const place = Math.min(Math.max((by.value(run, i) - low) / (high - low), 0), 1) * (stops.length - 1),
        stop = Math.min(Math.floor(place), stops.length - 2);
      mixed.lerpColors(stops[stop], stops[stop + 1], place - stop);
    } else mixed.copy(own);
    mixed.toArray(colours, 3 * i);
  }
  return colours;
}

class Report {
  constructor(data) {
    this.data = data;
    this.runs = data.runs;
    this.many = this.runs.length > 1;
    labelRuns(this.runs);
    this._words();
    if (this.runs.length) this._replay();
  }

  _words() {
    const { data, runs } = this,
      seek = (time) => this.lookAt(time);
    byId("made").textContent = `made by cosim ${data.made.cosim} on ${data.made.at}`;
    const fill = (id, ...content) => {
      byId(id).hidden = false;
      byId(id).append(...content);
    };
    if (data.evaluations.length) {
      byId("headline").append(make("p", { class: "kicker" }, "cosim report"));
      fill(
        "evaluations",
        ...data.evaluations.flatMap((evaluation) =>
          evaluationOf(evaluation, runs, (run) => this.focusOn(run)),
        ),
      );
    } else if (!this.many) byId("headline").append(...headlineOf(runs[0], seek), ...thinnedNotes(data));
    else {
      const flown = runs.filter((run) => run.outcome === "success").length;
      byId("headline").append(
        make("p", { class: "kicker" }, "cosim report"),
        make("h1", {}, `${runs.length} runs`),
        make("p", { class: "lead" }, `${flown} of ${runs.length} reached the end.`),
      );
    }
    if (this.many || (runs.length && data.evaluations.length)) {
      fill(
        "runs",
        data.evaluations.length ? make("h2", {}, "Replays") : "",
        runsTable(
          runs,
          (run) => this.focusOn(run),
          (run, shown) => this.show(run, shown),
        ),
        ...notesOf(runs),
        ...thinnedNotes(data),
      );
    }
  }

  _replay() {
    const { data, runs } = this;
    for (const id of ["replay", "transport", "plots", "phases", "settings"]) byId(id).hidden = false;
    this.player = new Player(runs, (time) => this._place(time));
    this.plots = new Plots(data, byId("charts"), (time) => {
      this.player.pause();
      this.player.seek(time);
    });
    this.dial = new Dial(byId("dial"));
    try {
      if (!has3d()) throw new Error("it is switched off, or there is no driver for it");
      this.view = new View(data, byId("canvas"));
    } catch (error) {
      byId("view").classList.add("flat");
      byId("no-view").hidden = false;
      byId("no-view").textContent =
        `No 3-D here, since this browser has no WebGL (${error.message}): seen from the side instead.`;
      byId("camera").parentElement.hidden = true;
    }
    this.stage = this.view ?? new Plan(data, byId("view"));
    this.colourBy = this.many ? "run" : "clearance";
    this._controls();
    const first = runs[0];
    this.choose(first, new Set(runs.filter((run) => run.tube === first.tube)));
    this.paint();
    this.view?.resize();
    this.player.seek(0);
    this.view?.setCamera("overview");
    if (!this.many && first.ending) this.goTo(first.ending.time);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.paint());
    const [, number] = location.hash.match(/run=(\d+)/) ?? [];
    if (runs[number]) this.focusOn(runs[number]);
  }

  _controls() {
    const press = (button, on) => button.setAttribute("aria-pressed", on);
    for (const button of byId("abscissa").children) {
      button.addEventListener("click", () => {
        for (const other of byId("abscissa").children) press(other, other === button);
        this.plots.by = button.value;
        this.plots.draw();
      });
    }
    byId("abscissa").before(
      this._select("Span", { Infinity: "all", 60: "60 s", 20: "20 s", 5: "5 s" }, "Infinity", (value) => {
        this.plots.span = +value;
        this.plots.draw();
      }),
    );
    const { view } = this;
    if (!view) return;
    byId("camera").addEventListener("change", (event) => view.setCamera(event.target.value));
    for (const [name, text] of Object.entries(LAYERS)) {
      const button = make(
        "button",
        {
          type: "button",
          "aria-pressed": "true",
          onclick: () => {
            press(button, !view.layers[name]);
            view.setLayer(name, !view.layers[name]);
          },
        },
        text,
      );
      byId("layers").append(button);
    }
    byId("layers").prepend(
      this._select("Tube", { glass: "glass", cut: "cut open", whole: "solid", off: "hidden" }, "glass", (value) =>
        view.setTube(value),
      ),
    );
    const colours = Object.fromEntries([
      ...(this.many ? [["run", "run"]] : []),
      ...Object.entries(PATH_COLOURS).map(([name, { text }]) => [name, text]),
    ]);
    this.scale = make("div", { class: "gradient" });
    byId("scale").append(
      this._select("Path by", colours, this.colourBy, (value) => {
        this.colourBy = value;
        this.paint();
      }),
      this.scale,
    );
  }

  _select(label, options, chosen, onChange) {
    const select = make(
      "select",
      { onchange: () => onChange(select.value) },
      ...Object.entries(options).map(([value, text]) =>
        make("option", { value, selected: value === chosen && "" }, text),
      ),
    );
    return make("label", {}, label, " ", select);
  }

  /** Colours of everything in the view, and the scale that explains the path's. */
  paint() {
    if (!this.view) return;
    const by = PATH_COLOURS[this.colourBy],
      range = by && rangeOf(this.runs, by);
    this.view.paint((run) => pathColours(run, by, range));
    this.view.place(this.player.time);
    this.scale.hidden = !by;
    if (!by) return;
    this.scale.style.setProperty("--stops", CLEARANCE_COLOURS.join(","));
    this.scale.replaceChildren(...range.map((value) => make("span", {}, `${say(value, 2)} ${by.unit}`)));
  }

  choose(focus, visible) {
    visible.add(focus);
    this.focus = focus;
    this.visible = visible;
    this.stage.choose(focus, visible);
    this.plots.choose(focus, visible);
    byId("ending").replaceChildren(...endingOf(focus, (time) => this.lookAt(time)));
    for (const whose of document.querySelectorAll(".whose")) whose.textContent = this.many ? ` · ${focus.label}` : "";
    byId("phase-rows").replaceChildren(...phasesOf(focus));
    byId("facts").replaceChildren(...factsOf(focus));
    for (const row of document.querySelectorAll("[data-run]")) {
      const run = this.runs[row.dataset.run];
      row.classList.toggle("focus", run === focus);
      row.querySelector("input").checked = visible.has(run);
    }
  }

  /** Look at a run: what it senses, its phases and settings, and, where it flew elsewhere, its tube. */
  focusOn(run) {
    const same = run.tube === this.focus.tube;
    this.player.pause();
    this.choose(run, same ? this.visible : new Set(this.runs.filter((other) => other.tube === run.tube)));
    if (run.ending) this.goTo(run.ending.time);
    else {
      this.player.seek(this.player.time);
      this.view?.setCamera(this.view.cameraMode);
    }
    byId("replay").scrollIntoView({ block: "start" });
  }

  /** Rest at a time (s), close to the drone. */
  goTo(time) {
    this.player.pause();
    this.player.seek(time);
    if (!this.view) return;
    if (this.view.cameraMode === "overview") byId("camera").value = "follow";
    this.view.setCamera(byId("camera").value);
    this.view.faceEnding();
  }

  /** Go there for a reader who may have scrolled the view away. */
  lookAt(time) {
    this.goTo(time);
    byId("view").scrollIntoView({ block: "nearest" });
  }

  show(run, shown) {
    if (shown) this.visible.add(run);
    else if (this.visible.size > 1) this.visible.delete(run);
    this.choose(this.visible.has(this.focus) ? this.focus : [...this.visible][0], this.visible);
    this._place(this.player.time);
  }

  _place(time) {
    this.stage.place(time);
    this.plots.place(time);
    this._readout(time);
  }

  _readout(time) {
    const run = this.focus,
      s = run.series,
      { record: i } = recordAt(run, time);
    const entries = [
      ["step", `${s.step[i].toLocaleString("en")} of ${run.steps.toLocaleString("en")}`],
      ["along the axis", `${fixed(s.arc_length[i], 2)} m`],
      ["gap to the wall", `${fixed(s.clearance[i] - run.body_radius, 3)} m`],
      ["speed", `${fixed(s.speed[i], 2)} m/s`],
      [
        "goes by",
        { visible: "the target", memory: "its memory", blind: "the walls alone" }[REGIMES[s.regime[i]]] ?? "–",
      ],
      ["alignment", fixed(s.alignment[i], 3)],
      ["turn confidence", fixed(s.C_turn[i], 3)],
      ["reward", fixed(s.reward[i], 2)],
      ["action", s.action[i] < 0 ? "–" : `${s.action[i]} of 36`],
      ["entropy", Number.isFinite(s.entropy[i]) ? `${fixed(s.entropy[i], 2)} nat` : "–"],
    ];
    if (this.many) entries.unshift(["run", run.label]);
    this.dial.place(run, i);
    byId("readout").replaceChildren(
      ...entries.map(([name, value]) => make("div", { class: name }, make("dt", {}, name), make("dd", {}, value))),
    );
  }

  /** What is shown now: record and time, whether it plays, and where each drone stands (m). */
  state() {
    const places = this.view?.runs.map((view) => view.drone.position.toArray());
    return {
      record: this.player.record,
      time: this.player.time,
      playing: this.player.playing,
      focus: this.focus.number,
      positions: places,
    };
  }
}

window.cosimReport = readData().then((data) => new Report(data));
window.cosimReport.then(() => {
  document.body.dataset.ready = "true";
});
