// The data of the page: JSON with the numbers of its arrays, and the arrays.

const TYPES = {
  f4: Float32Array,
  u1: Uint8Array,
  i1: Int8Array,
  u2: Uint16Array,
  i2: Int16Array,
  u4: Uint32Array,
  i4: Int32Array,
};

/** The data as `cosim/report.py` put it together, with every series as a typed array. */
async function readData() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const block = await inflate(document.getElementById("arrays").textContent);
  const array = (number) => {
    const { type, shape, at } = data.arrays[number];
    return new TYPES[type](
      block,
      at,
      shape.reduce((a, b) => a * b, 1),
    );
  };
  for (const tube of data.tubes) {
    for (const name of ["vertices", "faces", "outward", "axis"]) tube[name] = array(tube[name]);
  }
  data.runs.forEach((run, number) => {
    run.number = number;
    run.drone = { vertices: array(run.drone.vertices), faces: array(run.drone.faces) };
    for (const name of Object.keys(run.series)) run.series[name] = array(run.series[name]);
    run.count = run.series.time.length;
    run.end = run.series.time[run.count - 1];
  });
  return data;
}

async function inflate(base64) {
  const bytes = Uint8Array.fromBase64?.(base64) ?? Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** Where a run is at a time: the record at or before it, and how far on the way to the next, 0 to 1. */
function recordAt(run, time) {
  const times = run.series.time;
  let low = 0,
    high = run.count - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle - 1;
  }
  const span = low + 1 < run.count ? times[low + 1] - times[low] : 0;
  return { record: low, part: span > 0 ? Math.min(Math.max((time - times[low]) / span, 0), 1) : 0 };
}

const REGIMES = ["", "visible", "memory", "blind"];

/** A number for people: `digits` significant ones, a true minus sign, a dash for what is not known. */
function say(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (Math.abs(value) < 5e-6) return "0";
  const size = Math.floor(Math.log10(Math.abs(value)));
  const text = size >= digits ? Math.round(value).toLocaleString("en") : value.toFixed(Math.min(digits - 1 - size, 6));
  return text.replace("-", "−");
}

/** A number with so many decimals, or a dash. */
function fixed(value, digits) {
  if (!Number.isFinite(value)) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

function sayTime(seconds) {
  if (seconds < 1e-3) return `${say(1e6 * seconds)} µs`;
  return seconds < 1 ? `${say(1e3 * seconds)} ms` : `${say(seconds)} s`;
}

/** An element with attributes and children; text is never read as markup. */
function make(tag, attributes = {}, ...children) {
  const svg = /^(svg|g|path|rect|line|text|circle|title)$/.test(tag);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

function byId(id) {
  return document.getElementById(id);
}

/** The colour of a run among several; CSS has them as --run-0 and so on, for both colour schemes. */
function runColour(run) {
  return `var(--run-${run.number % 8})`;
}

/** What a CSS variable comes to now, as #rrggbb or another form that both CSS and three.js read. */
function cssColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
