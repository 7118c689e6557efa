// The flight from the side as a flat drawing: what there is to see where the browser draws no 3-D.

const PLAN_WIDTH = 1000;

class Plan {
  constructor(data, root) {
    this.data = data;
    this.svg = make("svg", { class: "plan", role: "img", "aria-label": "Tube, paths and drones seen from the side" });
    root.append(this.svg);
  }

  /** Draw the tube of the focus and the paths of what is seen in it; lengths in m, as wide as the tube is long. */
  choose(focus, visible) {
    const { axis } = this.data.tubes[focus.tube],
      back = broadside(axis),
      radius = focus.series.radius[0];
    const [across, point] = [new THREE.Vector3().crossVectors(UP, back), new THREE.Vector3()];
    const low = [Infinity, Infinity],
      high = [-Infinity, -Infinity];
    const flat = (array, i) => {
      vectorAt(array, i, point);
      return [point.dot(across), -point.z];
    };
    for (let i = 0; i < axis.length / 3; i++) {
      flat(axis, i).forEach((value, k) => {
        low[k] = Math.min(low[k], value - 1.5 * radius);
        high[k] = Math.max(high[k], value + 1.5 * radius);
      });
    }
    const scale = PLAN_WIDTH / (high[0] - low[0]);
    this.flat = (array, i) => flat(array, i).map((value, k) => scale * (value - low[k]));
    const line = (array, attributes) => {
      const points = Array.from({ length: array.length / 3 }, (_, i) => this.flat(array, i).map((x) => x.toFixed(1)));
      return make("path", { ...attributes, d: `M${points.map((place) => place.join(" ")).join("L")}` });
    };
    const runs = [...visible].filter((run) => run.tube === focus.tube);
    this.drones = runs.map((run) => ({ run, dot: make("circle", { r: 8, style: `fill:${runColour(run)}` }) }));
    const wall = focus.ending?.wall && this.flat(focus.ending.wall, 0);
    this.svg.setAttribute("viewBox", `0 0 ${PLAN_WIDTH} ${Math.max(scale * (high[1] - low[1]), 1).toFixed(0)}`);
    this.svg.replaceChildren(
      line(axis, { class: "lumen", style: `stroke-width:${(2 * scale * radius).toFixed(1)}` }),
      line(axis, { class: "axis" }),
      ...runs.map((run) => line(run.series.position, { style: `stroke:${runColour(run)}` })),
      ...this.drones.map(({ dot }) => dot),
      ...(wall ? [make("circle", { class: "wall", r: 12, cx: wall[0], cy: wall[1] })] : []),
    );
  }

  place(time) {
    for (const { run, dot } of this.drones ?? []) {
      const [x, y] = this.flat(run.series.position, recordAt(run, time).record);
      dot.setAttribute("cx", x.toFixed(1));
      dot.setAttribute("cy", y.toFixed(1));
    }
  }
}
