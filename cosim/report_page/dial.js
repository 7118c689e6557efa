// What the drone in focus knows at this moment, drawn as seen from behind it: right is right, up is up.

const DIAL = 100, // half its width
  LEAD = 0.5; // seconds of flight that an arrow is long
const DIAL_KEYS = {
  front: "front ring",
  rear: "rear ring",
  flown: "flown",
  decided: "decided",
  seen: "target",
  held: "remembered",
  wall: "wall met",
};

class Dial {
  constructor(root) {
    this.marks = {
      front: make("path", { class: "front" }),
      rear: make("path", { class: "rear" }),
      body: make("circle", { class: "body" }),
      flown: make("path", { class: "flown" }),
      decided: make("path", { class: "decided" }),
      held: make("path", { class: "held" }),
      seen: make("circle", { class: "seen", r: 5 }),
      wall: make("circle", { class: "wall", r: 5 }),
    };
    const svg = make(
      "svg",
      {
        viewBox: `${-DIAL} ${-DIAL} ${2 * DIAL} ${2 * DIAL}`,
        role: "img",
        "aria-label": "Cross-section seen from behind the drone: both LiDAR rings, its flight and its decision",
      },
      ...Object.values(this.marks),
    );
    this.keys = Object.fromEntries(
      Object.entries(DIAL_KEYS).map(([name, text]) => [name, make("span", { class: `key ${name}` }, text)]),
    );
    root.append(make("figcaption", {}, "seen from behind"), svg, make("div", { class: "legend" }, ...Object.values(this.keys)));
    this.axes = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
    this._turn = new THREE.Quaternion();
  }

  /** Show what `run` knows at a record. */
  place(run, record) {
    const { series, lidar } = run,
      [forward, up, right] = this.axes,
      { marks } = this;
    this._turn.fromArray(series.quaternion, 4 * record);
    forward.set(1, 0, 0).applyQuaternion(this._turn);
    up.set(0, 0, 1).applyQuaternion(this._turn);
    right.crossVectors(forward, up);
    run.widest ??= series.radius.reduce((a, b) => Math.max(a, b), 0);
    this.scale = DIAL / (1.25 * run.widest);
    marks.front.setAttribute("d", this._ring(run, record, 0));
    marks.rear.setAttribute("d", this._ring(run, record, lidar.rays));
    marks.body.setAttribute("r", this.scale * run.body_radius);
    this._arrow("flown", vectorAt(series.velocity, record, new THREE.Vector3()).multiplyScalar(LEAD));
    // What was decided here is what the next step was flown by.
    const next = Math.min(record + 1, run.count - 1);
    this._arrow(
      "decided",
      vectorAt(series.direction, next, new THREE.Vector3()).multiplyScalar(LEAD * series.commanded_speed[next]),
    );
    const seen = series.target_visible[record] > 0,
      held = !seen && series.memory_available[record] > 0;
    this._dot("seen", seen && this._from(run, record, vectorAt(series.target_position, record, new THREE.Vector3())));
    this._arrow(
      "held",
      held && vectorAt(series.memory_direction, record, new THREE.Vector3()).multiplyScalar(run.widest),
    );
    const wall = run.ending?.wall && this._from(run, record, new THREE.Vector3().fromArray(run.ending.wall));
    this._dot("wall", wall && wall.length() < 2 * run.widest && wall);
  }

  _from(run, record, point) {
    return point.sub(vectorAt(run.series.position, record, new THREE.Vector3()));
  }

  /** Across the drone in the dial's units, kept within it. */
  _across(vector) {
    const [, up, right] = this.axes,
      x = this.scale * vector.dot(right),
      y = -this.scale * vector.dot(up);
    const shrink = Math.min(1, (DIAL - 6) / Math.max(Math.hypot(x, y), 1e-9));
    return [shrink * x, shrink * y];
  }

  _ring(run, record, first) {
    const { rays, reach } = run.lidar;
    const points = Array.from({ length: rays }, (_, j) => {
      const length = (this.scale * reach * run.series.lidar[2 * rays * record + first + j]) / 255,
        phi = (2 * Math.PI * j) / rays;
      return `${(length * Math.cos(phi)).toFixed(1)} ${(-length * Math.sin(phi)).toFixed(1)}`;
    });
    return `M${points.join("L")}Z`;
  }

  _show(name, shown) {
    this.marks[name].setAttribute("visibility", shown ? "visible" : "hidden");
    if (this.keys[name]) this.keys[name].classList.toggle("absent", !shown);
  }

  _dot(name, vector) {
    this._show(name, !!vector);
    if (!vector) return;
    const [x, y] = this._across(vector);
    this.marks[name].setAttribute("cx", x.toFixed(1));
    this.marks[name].setAttribute("cy", y.toFixed(1));
  }

  _arrow(name, vector) {
    this._show(name, !!vector);
    if (!vector) return;
    const [x, y] = this._across(vector),
      length = Math.hypot(x, y),
      head = Math.min(7, length);
    const [a, b] = length > 0 ? [(head * x) / length, (head * y) / length] : [0, 0];
    const barb = (side) => `${(x - a - side * 0.6 * b).toFixed(1)} ${(y - b + side * 0.6 * a).toFixed(1)}`;
    const tip = `${x.toFixed(1)} ${y.toFixed(1)}`;
    this.marks[name].setAttribute("d", `M0 0L${tip}M${barb(1)}L${tip}L${barb(-1)}`);
  }
}
