"""What the paper leaves open or contradicts, and what is taken here: one table, rendered into PAPER.md.

Values are read from the settings and from the preset `paper`, so that the table cannot go stale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from agent_client.curriculum import THRESHOLDS, WINDOW
from agent_client.features import FEATURES
from agent_client.presets import PAPER
from agent_client.settings import max_steps
from agent_client.training_options import REWARD_SCALE
from meshes.curves import CURVATURE_CAP, DEGREES, PIECE_LENGTH, SELF_DISTANCE, STEP, TENSION

_S = PAPER.world.settings
_H = PAPER.hyperparameters
_LENGTH: Final = PIECE_LENGTH


@dataclass(frozen=True)
class Choice:
    """One value that the paper leaves open or contradicts."""

    section: str
    name: str
    paper: str
    """What the paper says."""
    taken: str
    """What the preset `paper` takes."""
    why: str


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):g} degrees"


def _rows(section: str, *rows: tuple[str, str, str, str]) -> tuple[Choice, ...]:
    return tuple(Choice(section, *row) for row in rows)


CHOICES: Final = (
    *_rows(
        "Observation",
        (
            "features", "37, listed one by one (Observation Space); 84 (Model Architecture)",
            f"{len(FEATURES)}", "the 37 are defined, the 84 are a number alone",
        ),
        (
            "frame of the position", "\"position normalized by the tube radius\"",
            "offset from the nearest axis point in the local frame, over R",
            "a position in the world would mean nothing in another tube",
        ),
        (
            "what the agent knows",
            "\"no information about the true geometry\", yet progress and position are features",
            "both are kept, none masked",
            "they are among the 37; the preset `robust` masks them",
        ),
        (
            "mapping to [-1, 1]", "every feature lies there; no mapping is given",
            "2x - 1 for quantities in [0, 1], clipped", "keeps the paper's bounds",
        ),
        (
            "second safety metric", "\"based on the LiDAR minimum distance\", no formula",
            f"(smallest distance - body radius) / {_S.task.safety_scale:g} m, clipped",
            "resolves the last centimetres before a touch, which the first metric does not",
        ),
        (
            "hidden target", "no values for direction and depth while the target is not seen",
            "direction 0, depth 1", "no direction at all, and as far as can be",
        ),
        (
            "length of the memory", "\"as long as it remains recent\"", f"{_S.memory.steps} control steps",
            "2 s, in which the fastest drone passes a bend",
        ),
        (
            "observation normalisation", "\"observation normalization\", no formula",
            f"running mean and variance, clipped to {_H.observation_clip:g}", "the usual one with PPO",
        ),
    ),
    *_rows(
        "Sensors",
        (
            "LiDAR", "two rings; no number of rays, range or distance (and \"rear-tilted\" in a photograph)",
            f"{_S.lidar.rays} rays a ring, {_S.lidar.reach:g} m, +-{_S.lidar.offset:g} m along the body, "
            "perpendicular to it", "the text says perpendicular; the range sees both walls of the tube",
        ),
        (
            "sectors", "left, right, top, bottom; no borders", "90 degrees each, centred on r, -r, u, -u",
            "the only symmetric choice",
        ),
        (
            "field of view", "half-angles from f_w, f_h and c, none of which is given",
            f"{_degrees(_S.camera.half_width)} and {_degrees(_S.camera.half_height)}", "a common wide lens",
        ),
        (
            "target", "\"the tube center\", \"vanishing point\", \"target point\"; no distance",
            f"the axis point {_S.camera.target_distance:g} m ahead, seen inside the field of view with a free "
            "line of sight", "it goes out of sight in the bends of levels 1 and 2, as the paper describes",
        ),
        (
            "depth", "\"normalized\"", f"over {_S.camera.depth_scale:g} m", "beyond the target's greatest distance",
        ),
    ),
    *_rows(
        "Actions and motion",
        (
            "actions", "36 discrete pairs (Action Space); continuous velocities (Model Architecture)",
            f"9 directions x {len(_S.actions.speeds)} speeds", "the discrete ones are defined",
        ),
        (
            "speed levels", "four, no values", f"{', '.join(f'{v:g}' for v in _S.actions.speeds)} m/s",
            "even steps; two radii a second at most",
        ),
        (
            "\"no backward orientations\"", "a constraint without a rule", "nothing: every angle is below 90 degrees",
            "with these half-angles it always holds",
        ),
        ("control step", "Δt, no value", f"{PAPER.dt:g} s", "the memory and the speeds then make sense in metres"),
        (
            "motion while training", "none is given",
            f"heading and speed go {_S.motion.heading_blend:g} and {_S.motion.speed_blend:g} of the way in a step; "
            "the frame follows by the smallest rotation", "a kinematic world without gimbal trouble",
        ),
        ("body", "no size", f"a sphere of {_S.drone.body_radius:g} m", "0.15 R"),
    ),
    *_rows(
        "Reward",
        (
            "reward per step", "positive in all but rare steps, whether the drone advances or not", "taken literally",
            "the presets `quick` and `robust` pay it per metre: the literal one rewards loitering",
        ),
        ("t_warmup", "no value", f"{_S.reward.warmup_steps} control steps", "the first second"),
        (
            "local axis in S_align", "used where neither target nor memory is there", "taken literally",
            "the reward may know what the agent does not",
        ),
        (
            "S_traj and S_center", "defined, and in no reward term", "in no reward term", "taken literally",
        ),
        (
            "end of an episode", "+10, -10, -1; not whether they replace the step's reward",
            "added to the last step's terms; -10 for exits and collisions alike", "nothing is lost either way",
        ),
        (
            "scale for the learner", "none", f"{REWARD_SCALE:g}; returns are shown unscaled",
            "keeps the value loss near the policy's loss",
        ),
        (
            "returns", "150 to 250 an episode", "whatever comes",
            "not comparable: they depend on length, speeds and step, none of which is given",
        ),
    ),
    *_rows(
        "Episodes",
        (
            "start", "none is given",
            f"{_S.start.arc_length:g} m into the tube, up to {_S.start.offset:g} R off the axis and "
            f"{_degrees(_S.start.heading_error)} off its direction, at rest", "every episode differs",
        ),
        (
            "success", "\"reaches the end of the tube\"",
            f"within {_S.task.success_radius:g} R of the end, along the axis", "before the open end is passed",
        ),
        (
            "failure", "\"failure without collision but loss of confinement\"; success and exits sum to 100 %",
            "contact of the body with the wall, or the centre outside",
            "told apart; the paper's exits are compared with their sum and the time-outs apart",
        ),
        (
            "episode limit", "a time-out exists, no value",
            f"{_S.task.time_factor:g} times the steps at the slowest speed: "
            f"{max_steps(_S, _LENGTH, PAPER.dt)} in {_LENGTH:g} m", "a shorter one fails slow but sound flights",
        ),
    ),
    *_rows(
        "Tubes and curriculum",
        ("size", "neither radius nor length", f"R = 1 m, {_LENGTH:g} m", "sizes in the paper are relative to R"),
        (
            "curve families", "(a) to (d), \"nearly straight\" to \"highly curved\", no formulas",
            "a bow, a wave, waves in two planes, a drifting helix (`meshes.curves`)",
            "median greatest curvature 0.13, 0.37, 0.58 per R, total turning 72, 211, 365 degrees by level",
        ),
        (
            "splines", "\"random tension and degree\"",
            f"degrees {DEGREES[0]} to {DEGREES[-1]}, tension {TENSION[0]:g} to {TENSION[1]:g}, "
            f"points every {STEP:g} m", "degree 1 would leave corners",
        ),
        (
            "tightest bend", "none is given", f"curvature {CURVATURE_CAP:g} per R, {SELF_DISTANCE:g} R between parts",
            "walls must neither fold nor meet",
        ),
        (
            "thresholds", f"{', '.join(f'{t:.2f}' for t in THRESHOLDS)} of the \"average success rate\", over no "
            "stated window", f"over the last {WINDOW} episodes at the level, a full window",
            "a rate of 0.8 is then known within 0.05",
        ),
        (
            "after the last threshold", "not said", "training goes on at the last level", "nothing is left to change",
        ),
        (
            "tubes", "a new one for every episode", f"one of {PAPER.pool:,} a level, drawn before the first step",
            "far more than are learnt by heart; the tubes of evaluation are never among them",
        ),
        (
            "success at the last level", "0.75 to 0.80 in the text, 87 % in the table", "whatever comes",
            "training's rate and evaluation's may differ",
        ),
    ),
    *_rows(
        "Learning",
        (
            "activation", "tanh, and \"relu for the final layers\"", f"{_H.activation}; linear outputs",
            "a relu before logits would cut half of them",
        ),
        (
            "network of the value", "not mentioned", f"one of its own, {_H.hidden[0]}-{_H.hidden[1]}",
            "it then cannot upset the policy's",
        ),
        (
            "batch", "13,000; but 13 actors x 1 environment x 200 steps are 2,600",
            f"{_H.lanes} x {_H.rollout} = {_H.batch:,}", "the batch is the number that learning depends on",
        ),
        ("learning rate", "3e-4; no schedule", f"{_H.learning_rate:g} throughout", "taken literally"),
        ("epochs", "no value", f"{_H.epochs}", "usual"),
        ("GAE's lambda", "no value", f"{_H.gae_lambda:g}", "usual"),
        (
            "what RLlib adds by default", "not mentioned",
            "nothing of it: stable-baselines3's defaults (value loss 0.5, gradient norm 0.5, no KL penalty)",
            "the paper's table is all that is stated",
        ),
        ("length of training", "\"the first few dozen iterations\" for the first level; no total",
         f"{PAPER.steps:,} steps, {PAPER.steps // _H.batch} iterations", "past all thresholds, and long after"),
    ),
    *_rows(
        "Evaluation and physics",
        (
            "actions when evaluated", "drawn or most likely: not stated", "most likely", "repeatable",
        ),
        (
            "look-ahead of Pure Pursuit", "no value",
            f"the camera's target, {_S.camera.target_distance:g} m, and the best of several beside it",
            "the two see equally far; the best one is the honest comparison",
        ),
        (
            "gravity compensation", "\"a small stabilizing vertical term\"",
            f"{_S.drone.compensation:g} of the weight", "partial, as the paper says",
        ),
        (
            "from command to force and torque", "\"transformed by Unity\"",
            "protocol/README.md, annex A", "one law, written down, for every engine",
        ),
    ),
)  # fmt: skip
"""Every such value, in the order of the paper's sections."""

_TITLE: Final = """# What the paper leaves open, and what is taken

The preset `paper` takes everything that the paper states. It contradicts itself in places and leaves much open;
this table has every such value. `cosim train --preset paper --explain` prints it.
"""


def to_markdown() -> str:
    """The table as markdown; the content of PAPER.md."""
    lines = [_TITLE]
    for section in dict.fromkeys(choice.section for choice in CHOICES):
        lines += [f"## {section}", "", "| value | the paper says | taken | why |", "|---|---|---|---|"]
        lines += [
            f"| {choice.name} | {choice.paper} | {choice.taken} | {choice.why} |"
            for choice in CHOICES
            if choice.section == section
        ]
        lines.append("")
    return "\n".join(lines)
