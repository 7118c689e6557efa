// What is plotted, chart by chart.

/** What is plotted: `curves(run)` gives label and values of each curve; the first one is shown where there are many runs. */
const CHARTS = [
  {
    name: "clearance",
    title: "Clearance",
    unit: "m",
    floor: 0,
    curves: (run) => [
      { label: "centre to wall", values: run.series.clearance },
      { label: "local radius R", values: run.series.radius, quiet: true },
    ],
    lines: (run) => [{ label: "body", value: run.body_radius, bad: true }],
  },
  {
    name: "curvature",
    title: "Curvature of the axis",
    unit: "1/m",
    floor: 0,
    curves: (run) => [{ label: "here", values: run.series.curvature }],
  },
  {
    name: "speed",
    title: "Speed",
    unit: "m/s",
    floor: 0,
    curves: (run) => [
      { label: "flown", values: run.series.speed },
      { label: "commanded", values: run.series.commanded_speed, quiet: true },
    ],
  },
  {
    name: "alignment",
    title: "Alignment and centring",
    unit: "",
    ceiling: 1,
    curves: (run) => [
      { label: "alignment", values: run.series.alignment },
      { label: "centring", values: run.series.centring },
      { label: "Q so far", values: run.series.quality },
    ],
  },
  { name: "regime", title: "What the drone goes by", unit: "", strip: true },
  {
    name: "memory",
    title: "Since the target was seen",
    unit: "steps",
    floor: 0,
    curves: (run) => [{ label: "age of the memory", values: run.series.memory_age }],
    lines: (run) => [{ label: "forgotten", value: run.memory_steps }],
  },
  {
    name: "symmetry",
    title: "LiDAR symmetry",
    unit: "",
    floor: 0,
    ceiling: 1,
    curves: (run) => [
      { label: "front S_F", values: run.series.S_F },
      { label: "rear S_R", values: run.series.S_R },
      { label: "turn C_turn", values: run.series.C_turn },
    ],
  },
  {
    name: "entropy",
    title: "Entropy of the policy",
    unit: "nat",
    floor: 0,
    curves: (run) => [{ label: "of the 36 actions", values: run.series.entropy }],
    missing: "no distribution: this pilot chooses by rule",
  },
  { name: "reward", title: "Reward by its terms", unit: "", floor: 0, wide: true, curves: rewardCurves },
  {
    name: "step_time",
    title: "Time of a step",
    unit: "ms",
    floor: 0,
    wide: true,
    clipped: true,
    curves: (run) => [
      { label: "without recording", values: (run.step_ms ??= run.series.step_time.map((s) => 1e3 * s || NaN)) },
    ],
  },
];

function rewardCurves(run) {
  run.reward_curves ??= (() => {
    const names = run.terms,
      all = run.series.reward_terms,
      end = names.indexOf("terminal");
    const values = names.map((_, t) => Float32Array.from({ length: run.count }, (_, i) => all[names.length * i + t]));
    const sum = run.series.reward.map((reward, i) => reward - values[end][i]);
    const shown = names
      .map((name, t) => ({ label: name.replace("_", " "), values: values[t] }))
      .filter((curve, t) => t !== end && curve.values.some((value) => value !== 0));
    return [{ label: "sum without the end’s", values: sum }, ...shown];
  })();
  return run.reward_curves;
}
