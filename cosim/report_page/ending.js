// How a flight went wrong: in words, and where in the view.

/** What happened and what was known of it; nothing where nothing went wrong. */
function endingOf(run, onSeek) {
  const { ending } = run;
  if (!ending) return [];
  const button = (text, time, title) =>
    make("button", { type: "button", title, onclick: () => onSeek(time) }, text);
  const facts = ending.facts.map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text)));
  return [
    make("h2", {}, ending.title),
    make(
      "p",
      { class: "moments" },
      button(ending.wall ? "Show the moment" : "Show the end", ending.time, "Put the replay there"),
      button("What it saw before", ending.before, "The record by which that step was decided"),
      button("2 s before", Math.max(ending.time - 2, 0), "Then press play"),
    ),
    make("dl", {}, ...facts),
  ];
}

/** The place on the wall that was met, marked and named whatever is in front of it. */
class EndingView {
  constructor(run, parent) {
    this.run = run;
    this.spot = spots(1, 22, true);
    this.spot.material.depthTest = false;
    this.spot.renderOrder = 31;
    this.spot.position.fromArray(run.ending.wall);
    this.label = make("span", { class: "pin" }, "wall met here");
    parent.append(this.label);
    this._at = new THREE.Vector3();
  }

  paint() {
    this.spot.material.uniforms.colour.value.set(cssColour("--bad"));
  }

  /** Put the name beside the mark, where the camera has it in front; once a drawing. */
  pin(camera, width, height, shown) {
    this.spot.visible = shown;
    const { x, y, z } = this._at.copy(this.spot.position).project(camera);
    this.label.hidden = !shown || Math.abs(x) > 1 || Math.abs(y) > 1 || z > 1;
    if (!this.label.hidden)
      this.label.style.transform = `translate(${(0.5 + 0.5 * x) * width}px, ${(0.5 - 0.5 * y) * height}px)`;
  }
}
