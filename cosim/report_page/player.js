// The clock of the replay: slider, buttons, keys, and what follows the time.

const RATES = [0.1, 0.25, 0.5, 1, 2, 5, 10, 25, 100];
const LONGEST_REPLAY = 60; // seconds of watching that the first choice of speed leads to at most

/** Simulated time, moved by hand or by itself. The slider counts the records of the longest run. */
class Player {
  constructor(runs, onTime) {
    this.guide = runs.reduce((a, b) => (b.end > a.end ? b : a));
    this.onTime = onTime;
    this.time = 0;
    this.playing = false;
    this.slider = byId("slider");
    this.slider.max = this.guide.count - 1;
    this.slider.addEventListener("input", () => this.seekRecord(+this.slider.value));
    byId("play").addEventListener("click", () => this.toggle());
    byId("back").addEventListener("click", () => this.step(-1));
    byId("forward").addEventListener("click", () => this.step(1));
    const chosen = RATES.find((rate) => rate >= 1 && this.guide.end / rate <= LONGEST_REPLAY) ?? RATES.at(-1);
    byId("rate").append(
      ...RATES.map((rate) => make("option", { value: rate, selected: rate === chosen && "" }, `${rate} ×`)),
    );
    document.addEventListener("keydown", (event) => this._key(event));
  }

  get record() {
    return recordAt(this.guide, this.time).record;
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.guide.end);
    const record = this.record,
      value = this.guide.series.step[record];
    this.slider.value = record;
    this.slider.setAttribute("aria-valuetext", `step ${value}, ${this.time.toFixed(1)} seconds`);
    byId("clock").textContent = `${this.time.toFixed(1)} s`;
    this.onTime(this.time);
  }

  seekRecord(record) {
    this.seek(this.guide.series.time[Math.min(Math.max(record, 0), this.guide.count - 1)]);
  }

  step(by) {
    this.pause();
    this.seekRecord(this.record + by);
  }

  toggle() {
    if (this.playing) return this.pause();
    if (this.time >= this.guide.end) this.seek(0);
    this._playing(true);
    let before = performance.now();
    const tick = (now) => {
      if (!this.playing) return;
      const passed = Math.min(now - before, 200) / 1000; // a window in the background does not jump ahead
      before = now;
      this.seek(this.time + passed * +byId("rate").value);
      if (this.time >= this.guide.end) this._playing(false);
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  /** Stop on a recorded moment. */
  pause() {
    if (!this.playing) return;
    this._playing(false);
    this.seekRecord(this.record);
  }

  _playing(playing) {
    this.playing = playing;
    byId("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    document.body.classList.toggle("playing", playing);
  }

  _key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const own = event.target.closest?.("input, select, button, summary, a");
    if (event.key === " " && !own) this.toggle();
    else if (event.key === "ArrowRight" && !own) this.step(event.shiftKey ? 10 : 1);
    else if (event.key === "ArrowLeft" && !own) this.step(event.shiftKey ? -10 : -1);
    else return;
    event.preventDefault();
  }
}
