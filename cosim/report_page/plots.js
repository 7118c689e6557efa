// Curves over time or arc length, drawn as SVG so that they follow the colour scheme and print well.

const HEIGHT = 132,
  MARGIN = { left: 54, right: 8, top: 6, bottom: 18 };

/** Ticks at 1, 2 or 5 times a power of ten, about `count` of them. */
function ticks(low, high, count) {
  const rough = (high - low) / count || 1,
    power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((n) => n * power >= rough) * power;
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) found.push(n * step);
  return found.map((value) => ({
    value,
    text: say(+value.toFixed(10), 3)
      .replace(/(\.\d*?)0+$/, "$1")
      .replace(/\.$/, ""),
  }));
}

/** A path through records `from` to `to` with no more detail than pixels: of many, first, least, greatest and last. */
function trace(xs, ys, from, to, toX, toY, width) {
  const chunk = Math.max(1, Math.floor((to - from + 1) / width));
  let path = "",
    pen = false;
  const put = (i) => {
    if (!Number.isFinite(ys[i])) {
      pen = false;
      return;
    }
    path += `${pen ? "L" : "M"}${toX(xs[i]).toFixed(1)} ${toY(ys[i]).toFixed(1)}`;
    pen = true;
  };
  for (let start = from; start <= to; start += chunk) {
    const stop = Math.min(start + chunk - 1, to);
    if (chunk < 4) {
      for (let i = start; i <= stop; i++) put(i);
      continue;
    }
    let least = start,
      most = start;
    for (let i = start; i <= stop; i++) {
      if (!(ys[i] >= ys[least])) least = i;
      if (!(ys[i] <= ys[most])) most = i;
    }
    for (const i of [...new Set([start, Math.min(least, most), Math.max(least, most), stop])]) put(i);
  }
  return path;
}

/** Runs of records of one value; where a pixel has several records, the worst of them is its value. */
function bands(xs, values, from, to, toX, worse) {
  const found = [];
  for (let i = from; i <= to; ) {
    const start = i,
      pixel = Math.floor(toX(xs[i]));
    let value = values[i];
    while (i <= to && Math.floor(toX(xs[i])) === pixel) value = worse(value, values[i++]);
    const last = found.at(-1);
    if (last?.value === value) last.end = i - 1;
    else found.push({ start, end: i - 1, value });
  }
  return found;
}

class Chart {
  constructor(definition, plots) {
    this.definition = definition;
    this.plots = plots;
    this.legend = make("div", { class: "legend" });
    this.svg = make("svg", { role: "img", "aria-label": definition.title, height: HEIGHT });
    const first = plots.all.length > 1 ? definition.curves?.(plots.all[0])[0].label : null;
    const unit = make("small", {}, [first, definition.unit].filter(Boolean).join(", "));
    this.root = make(
      "figure",
      { class: definition.wide ? "chart wide" : "chart", id: `chart-${definition.name}` },
      make("figcaption", {}, make("b", {}, definition.title), unit, this.legend),
      this.svg,
    );
    for (const kind of ["pointerdown", "pointermove"]) {
      this.svg.addEventListener(kind, (event) => {
        if (kind === "pointerdown") this.svg.setPointerCapture(event.pointerId);
        const x = this.fromX(event.clientX - this.svg.getBoundingClientRect().left);
        if (event.buttons & 1) plots.seek(x);
        else plots.peek(x);
      });
    }
    this.svg.addEventListener("pointerleave", () => plots.peek(null));
  }

  /** The curves of all visible runs, or those of the only one. */
  curves() {
    const { definition, plots } = this;
    if (definition.strip) return [];
    const many = plots.runs.length > 1;
    return plots.runs
      .flatMap((run) =>
        definition
          .curves(run)
          .map((curve, i) => ({ ...curve, run, colour: many ? runColour(run) : `var(--curve-${i % 8})` }))
          .filter((curve, i) => curve.values && (!many || i === 0))
          .map((curve) => (many ? { ...curve, label: run.label, quiet: false } : curve)),
      )
      .filter((curve) => curve.values.some(Number.isFinite));
  }

  draw() {
    const { definition, plots } = this,
      { width } = this;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    const [left, right] = [MARGIN.left, width - MARGIN.right],
      [x0, x1] = plots.range;
    this.toX = (x) => left + ((x - x0) / (x1 - x0 || 1)) * (right - left);
    this.fromX = (pixel) => x0 + ((pixel - left) / (right - left)) * (x1 - x0);
    this.drawn = this.curves();
    const body = make("g", { class: "body" });
    if (definition.strip) this._strips(body);
    else if (this.drawn.length) this._curves(body, left, right);
    else
      body.append(make("text", { x: left + 8, y: HEIGHT / 2, class: "missing" }, definition.missing ?? "nothing recorded"));
    const met = plots.focus.ending;
    if (met) {
      const x = this.toX(plots.abscissa(plots.focus)[recordAt(plots.focus, met.time).record]);
      if (x >= left && x <= right)
        body.append(make("line", { x1: x, x2: x, y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom, class: "limit bad" }));
    }
    const unit = plots.by === "time" ? " s" : " m";
    const below = ticks(x0, x1, width / 90).map(({ value, text }, i, all) =>
      make("text", { x: this.toX(value), y: HEIGHT - 4, class: "tick x" }, i === all.length - 1 ? text + unit : text),
    );
    this.place = make("text", { y: MARGIN.top + 9, class: "tick place" });
    const line = make("line", { y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom });
    this.cursor = make("g", { class: "cursor" }, line, this.place);
    this.svg.replaceChildren(body, ...below, this.cursor);
    this._legend();
    this.point();
  }

  _curves(body, left, right) {
    const { definition, plots } = this;
    let [low, high] = [definition.floor ?? Infinity, definition.ceiling ?? -Infinity];
    const lines = plots.runs.length === 1 ? (definition.lines?.(plots.runs[0]) ?? []) : [];
    for (const { values } of this.drawn) {
      const finite = values.filter(Number.isFinite);
      const top = definition.clipped ? 1.3 * finite.slice().sort()[Math.floor(0.995 * (finite.length - 1))] : null;
      for (const value of finite) {
        if (value < low) low = value;
        if (value > high && (top === null || value <= top)) high = value;
      }
    }
    for (const { value } of lines) high = Math.max(high, value);
    if (!(high > low)) high = low + 1;
    high += 0.04 * (high - low);
    const bottom = HEIGHT - MARGIN.bottom;
    this.toY = (y) => Math.max(bottom - ((y - low) / (high - low)) * (bottom - MARGIN.top), 0);
    for (const { value, text } of ticks(low, high, 3)) {
      const y = this.toY(value);
      body.append(
        make("line", { x1: left, x2: right, y1: y, y2: y, class: "grid" }),
        make("text", { x: left - 6, y: y + 3.5, class: "tick y" }, text),
      );
    }
    for (const { value, bad } of lines) {
      const y = this.toY(value);
      body.append(make("line", { x1: left, x2: right, y1: y, y2: y, class: bad ? "limit bad" : "limit" }));
    }
    for (const curve of this.drawn.slice().reverse()) {
      const [from, to] = plots.records(curve.run);
      const d = trace(plots.abscissa(curve.run), curve.values, from, to, this.toX, this.toY, right - left);
      body.append(make("path", { d, class: curve.quiet ? "curve quiet" : "curve", style: `stroke:${curve.colour}` }));
    }
  }

  /** Bands of colour: regime by regime of the only run with contact below, or the regimes of many runs. */
  _strips(body) {
    const { plots } = this,
      many = plots.runs.length > 1;
    const rows = many
      ? plots.runs.map((run) => ({ label: "", run, values: run.series.regime, kind: "regime", worse: Math.max }))
      : ["regime", "target_visible", "memory_available", "contact"].map((name) => ({
          label: { regime: "regime", target_visible: "target", memory_available: "memory", contact: "contact" }[name],
          run: plots.runs[0],
          values: plots.runs[0].series[name],
          kind: name === "regime" ? name : `${name} flag`,
          worse: name === "regime" || name === "contact" ? Math.max : Math.min,
        }));
    const high = (HEIGHT - MARGIN.top - MARGIN.bottom) / rows.length;
    rows.forEach(({ label, run, values, kind, worse }, row) => {
      const xs = plots.abscissa(run),
        [from, to] = plots.records(run),
        y = MARGIN.top + row * high;
      if (many)
        body.append(make("circle", { cx: MARGIN.left - 12, cy: y + high / 2, r: 4, style: `fill:${runColour(run)}` }));
      else body.append(make("text", { x: MARGIN.left - 6, y: y + high / 2 + 3.5, class: "tick y" }, label));
      for (const { start, end, value } of bands(xs, values, from, to, this.toX, worse)) {
        const a = this.toX(xs[start]),
          b = this.toX(xs[Math.min(end + 1, to)]);
        if (value)
          body.append(
            make("rect", {
              x: Math.min(a, b),
              y: y + 2,
              width: Math.max(Math.abs(b - a), 0.7),
              height: high - 4,
              class: `${kind} v${value}`,
            }),
          );
      }
    });
  }

  _legend() {
    const strip = this.definition.strip
      ? REGIMES.slice(1).map((name, i) => make("span", { class: `key regime v${i + 1}` }, name))
      : [];
    this.values = this.drawn.map((curve) => {
      const value = make("output", {});
      return { curve, value, dot: make("circle", { r: 2.8, style: `fill:${curve.colour}` }) };
    });
    const keys = this.values.map(({ curve, value }) =>
      make(
        "span",
        { class: curve.quiet ? "key quiet" : "key", style: `--key:${curve.colour}` },
        curve.label,
        " ",
        value,
      ),
    );
    this.legend.replaceChildren(...strip, ...keys);
    this.cursor.append(...this.values.map(({ dot }) => dot));
  }

  /** Move the cursor to where the mouse points, else to where the runs are now. */
  point() {
    const { plots } = this,
      focus = plots.focus,
      time = plots.peeked ?? plots.time,
      { record } = recordAt(focus, time);
    const here = plots.abscissa(focus)[record],
      x = this.toX(here),
      line = this.cursor.firstChild;
    line.setAttribute("x1", x.toFixed(1));
    line.setAttribute("x2", x.toFixed(1));
    const late = x > 0.8 * this.width;
    this.place.textContent =
      plots.peeked === null ? "" : plots.by === "time" ? `${fixed(here, 1)} s` : `${fixed(here, 2)} m`;
    this.place.setAttribute("x", (late ? x - 5 : x + 5).toFixed(1));
    this.place.setAttribute("text-anchor", late ? "end" : "start");
    for (const { curve, value, dot } of this.values) {
      const at = recordAt(curve.run, time).record,
        y = curve.values[at];
      value.textContent = say(y);
      dot.setAttribute("visibility", Number.isFinite(y) ? "visible" : "hidden");
      if (!Number.isFinite(y)) continue;
      dot.setAttribute("cx", this.toX(plots.abscissa(curve.run)[at]).toFixed(1));
      dot.setAttribute("cy", this.toY(y).toFixed(1));
    }
  }
}

/** All charts, which share their horizontal axis and the cursor. */
class Plots {
  constructor(data, root, onSeek) {
    this.runs = this.all = data.runs;
    this.focus = data.runs[0];
    this.onSeek = onSeek;
    this.by = "time";
    this.span = Infinity;
    this.time = 0;
    this.peeked = null;
    this.charts = CHARTS.map((definition) => new Chart(definition, this));
    root.append(...this.charts.map((chart) => chart.root));
    this.measure();
    new ResizeObserver(() => this.measure() && this.draw()).observe(root);
  }

  abscissa(run) {
    return run.series[this.by];
  }

  /** First and last record of a run within the span around the cursor. */
  records(run) {
    if (this.span === Infinity) return [0, run.count - 1];
    return [recordAt(run, this.time - this.span / 2).record, recordAt(run, this.time + this.span / 2).record];
  }

  /** Least and greatest x of what is shown. */
  get range() {
    if (this.by === "time" && this.span !== Infinity) return [this.time - this.span / 2, this.time + this.span / 2];
    let low = Infinity,
      high = -Infinity;
    for (const run of this.runs) {
      const xs = this.abscissa(run),
        [from, to] = this.records(run);
      for (let i = from; i <= to; i++) {
        if (xs[i] < low) low = xs[i];
        if (xs[i] > high) high = xs[i];
      }
    }
    return [low, high > low ? high : low + 1];
  }

  choose(focus, visible) {
    this.focus = focus;
    this.runs = this.all.filter((run) => visible.has(run));
    this.draw();
  }

  /** Take the charts' widths, all before anything is drawn; returns whether they changed. */
  measure() {
    const widths = this.charts.map((chart) => chart.svg.clientWidth || 300);
    const changed = this.charts.some((chart, i) => chart.width !== widths[i]);
    this.charts.forEach((chart, i) => (chart.width = widths[i]));
    return changed;
  }

  draw() {
    this.charts.forEach((chart) => chart.draw());
  }

  place(time) {
    this.time = time;
    if (this.span === Infinity) this.charts.forEach((chart) => chart.point());
    else this.draw();
  }

  /** Read the curves off where the focus was at this x, without going there; null ends it. */
  peek(x) {
    this.peeked = x === null ? null : this._timeAt(x);
    this.charts.forEach((chart) => chart.point());
  }

  /** Go to where the focus was at this x. */
  seek(x) {
    this.peeked = null;
    this.onSeek(this._timeAt(x));
  }

  _timeAt(x) {
    const xs = this.abscissa(this.focus),
      [from, to] = this.records(this.focus);
    let best = from;
    for (let i = from; i <= to; i++) if (Math.abs(xs[i] - x) < Math.abs(xs[best] - x)) best = i;
    return this.focus.series.time[best];
  }
}
