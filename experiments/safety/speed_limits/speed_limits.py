"""Limits of the speed of all parts and of the jerk of the joints in at least 1e7 worst-case steps."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.filter import Rank, SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.safety import random_scenes
from experiments.safety.adversary.classes import FAST_OBSTACLE, UNDISTURBED
from experiments.safety.reference_judge import build_judge, obstacle_rows, true_h
from experiments.safety.speed_limits.classes import CLASSES, COMPLETE_CLASSES, HELD, NEGATIVE_CONTROLS, SpeedClass
from experiments.safety.speed_limits.point_speeds import Array, PointSpeeds

EPISODES_PER_UNIT, STEPS_PER_EPISODE = 10, 10_000
BLOCKS, CONTROL_BLOCKS = 11, 2
CHUNK = 2000
"""Number of states that are judged at once."""
PERSON = Capsule(0.1, 0.6)
NEAR_ROUNDING, JERK_ROUNDING = 1e-4, 1e-3
"""Distance [m] that single precision leaves undecided at the edge of the person's distance, and share of the jerk."""
USED = 0.97
"""Share of a limit from which a step counts as one that uses it."""
STATUSES = ("safe", "modified", "relaxed", "stopped", "fault")
EXACT_ATTACK = {
    **UNDISTURBED,
    **{name: FAST_OBSTACLE[name] for name in ("evadable", "mover_speed", "mover_acceleration")},
}
SUMMED = ("steps", "above", "jerks", "used", "near", *STATUSES)


class SpeedLimits:
    """Limits of speed and jerk against an adversary, by a judge in float64 that shares no code with the filter."""

    name = "speed_limits"
    claim = (
        "In at least 1e7 adversarial steps of Panda and UR5e, no part, also of a grasped object, is faster than the "
        "limit of the filter or, near a person, than the limit of the site, also while the arm evades an obstacle; no "
        "joint exceeds its jerk limit; each negative control fails."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Blocks of every class, then of the negative controls."""
        del options
        kinds = [(kind, block) for block in range(BLOCKS) for kind in COMPLETE_CLASSES]
        kinds += [(kind, block) for block in range(CONTROL_BLOCKS) for kind in NEGATIVE_CONTROLS]
        return [WorkUnit(f"{kind.name} {block}", {"class": kind.name, "block": block}) for kind, block in kinds]

    def run(self, parameters: dict[str, Any]) -> Row:
        """`EPISODES_PER_UNIT` random scenes of `STEPS_PER_EPISODE` steps each."""
        first = parameters["block"] * EPISODES_PER_UNIT
        seeds = range(first, first + EPISODES_PER_UNIT)
        return {**parameters, **aggregate(run_episode(CLASSES[parameters["class"]], seed) for seed in seeds)}

    def summarize_row(self, row: Row) -> str:
        """The steps above the limit, and the largest share of it."""
        return f"above on {row['above']} of {row['steps']} steps, at most {row['largest']:.4f} of the limit"

    def report(self, rows: list[Row]) -> list[str]:
        """The verdict, the classes, and the negative controls."""
        totals = {
            name: aggregate(group) for name in CLASSES if (group := [one for one in rows if one["class"] == name])
        }
        return [*_verdict(totals), "", *_class_table(totals), "", *_control_table(totals)]


def run_episode(kind: SpeedClass, seed: int, steps: int = STEPS_PER_EPISODE) -> Row:
    """The counts of one random scene and start posture."""
    robot_model, judge = load_arm(kind.robot)
    rng = np.random.default_rng([seed, zlib.crc32((kind.compared_with or kind.name).encode())])
    start = random_scenes.random_posture(robot_model, judge, rng)
    obstacles = random_scenes.random_obstacles(judge, start, rng, int(rng.integers(4, 9)))
    safety = SafetyFilter(robot_model, kind.filter_config())
    if kind.holds_object and kind.knows_object:
        safety.attach(np.array(HELD), 0.0)
    if kind.evades:
        moving = random_scenes.random_moving_obstacle(judge, start, rng)
        q, u, counts = _attacked_loop(safety, judge, [*obstacles, moving], start, seed, steps)
        return _judged(kind, q, u, None) | counts
    person = _random_person(judge, start, rng) if kind.near else None
    known = [_with_limit(person, kind)] if person else []
    q, u, counts = _driven_loop(safety, [*obstacles, *known], start, seed, steps)
    return _judged(kind, q, u, person) | counts


def aggregate(counts: Iterable[Row]) -> Row:
    """Sums and maxima of the counts of several episodes."""
    group = list(counts)
    sums = {name: sum(one[name] for one in group) for name in SUMMED}
    return sums | {name: max(one[name] for one in group) for name in ("largest", "jerk")}


@cache
def load_arm(robot: str) -> tuple[RobotModel, ReferenceDistance]:
    """The robot with all spheres, fingers closed, and the reference distances for it."""
    robot_model = load_robot(robot)
    return robot_model, build_judge(robot_model)


def _random_person(judge: ReferenceDistance, q: Array, rng: np.random.Generator) -> Obstacle:
    """An upright person at rest within reach, at least 5 cm from the arm at `q` (n,)."""
    while True:
        reach, turn = rng.uniform(0.45, 0.9), rng.uniform(-np.pi, np.pi)
        pose = Pose((float(reach * np.cos(turn)), float(reach * np.sin(turn)), 0.5))
        person = Obstacle(name="person", shape=PERSON, pose=pose, static=False, rank=Rank.BODY)
        if true_h(judge, q[None], [person])[0, 1] > 0.05:
            return person


def _with_limit(person: Obstacle, kind: SpeedClass) -> Obstacle:
    """The person as the filter knows her."""
    return Obstacle(
        name=person.name,
        shape=person.shape,
        pose=person.pose,
        static=False,
        rank=person.rank,
        near=kind.near if kind.knows_near else None,
    )


def _driven_loop(
    safety: SafetyFilter, obstacles: list[Obstacle], start: Array, seed: int, steps: int
) -> tuple[Array, Array, Row]:
    """Postures before each step, controls, and counts by status; the nominal control attacks the nearest rows."""
    safety.observe(obstacles, 0.0)
    safety.reset()
    n = len(start)
    q, after, u = start.copy(), np.empty((steps, n)), np.empty((steps, n))
    counts = safety._kernel.closed_loop(q, seed, (150, 400, 1000)[seed % 3], 0.7, after, u, np.empty(steps, np.int8))
    return np.vstack([start, after[:-1]]), u, {name: int(counts[name]) for name in STATUSES}


def _attacked_loop(
    safety: SafetyFilter, judge: ReferenceDistance, obstacles: list[Obstacle], start: Array, seed: int, steps: int
) -> tuple[Array, Array, Row]:
    """As `_driven_loop`, with an obstacle that attacks; the controls follow from the postures, which integrate them."""
    safety.observe(obstacles, 0.0)
    safety.reset()
    q, after = start.copy(), np.empty((steps, len(start)))
    settings = {**EXACT_ATTACK, "seed": seed, "steps": steps, "hold": (150, 400, 1000)[seed % 3]}
    counts = judge.run_worst_case_loop(safety._kernel.handles(), obstacle_rows(obstacles), settings, q, after)
    before = np.vstack([start, after[:-1]])
    u = (after - before) / safety.robot_model.period
    return before, u, dict(zip(STATUSES, map(int, counts["status"]), strict=True))


def _judged(kind: SpeedClass, q: Array, u: Array, person: Obstacle | None) -> Row:
    """Steps above a limit or near it, the largest share of a limit, and steps with a part near the person."""
    robot_model = load_arm(kind.robot)[0]
    points = PointSpeeds(robot_model, np.array(HELD) if kind.holds_object else np.zeros((0, 4)))
    radii, shares, near = points.radii(), [], []
    for first in range(0, len(q), CHUNK):
        positions, speeds = points.measure(q[first : first + CHUNK], u[first : first + CHUNK])
        limits = np.full(speeds.shape, np.inf if kind.limit is None else kind.limit)
        if person is not None and kind.near is not None:
            close = _distance(positions, person) - radii < kind.near.distance - NEAR_ROUNDING
            limits = np.where(close, np.minimum(limits, kind.near.speed), limits)
            near.append(close.any(axis=1))
        shares.append((speeds / limits).max(axis=1))
    share = np.concatenate(shares)
    jerk = _jerk_shares(robot_model, u) if kind.judges_jerk else np.zeros(1)
    return {
        "steps": len(q),
        "above": int((share > 1.0).sum()),
        "used": int((share > USED).sum()),
        "near": int(np.concatenate(near).sum()) if near else 0,
        "jerks": int((jerk > 1.0 + JERK_ROUNDING).sum()),
        "largest": float(share.max()),
        "jerk": float(jerk.max()),
    }


def _distance(positions: Array, person: Obstacle) -> Array:
    """Distances (t, k) [m] of points (t, k, 3) from the surface of the upright person."""
    x, y, z = person.pose.position
    along = np.clip(positions[..., 2], z - PERSON.half_length, z + PERSON.half_length)
    return np.hypot(np.hypot(positions[..., 0] - x, positions[..., 1] - y), positions[..., 2] - along) - PERSON.radius


def _jerk_shares(robot_model: RobotModel, u: Array) -> Array:
    """Largest share (t,) of the jerk limit of a joint; the arm starts at rest."""
    limits = np.array([joint.jerk.value if joint.jerk else np.inf for joint in robot_model.joints])
    rest = np.zeros((2, robot_model.n))
    changes = np.diff(np.vstack([rest, u]), n=2, axis=0) / robot_model.period**2
    return np.abs(changes / limits).max(axis=1)


def _verdict(totals: dict[str, Row]) -> list[str]:
    found = [totals[kind.name] for kind in COMPLETE_CLASSES if kind.name in totals]
    steps, above = sum(one["steps"] for one in found), sum(one["above"] for one in found)
    return [
        f"**{steps:.3g}** steps: a part above its limit on **{above}**, a joint above its jerk limit on "
        f"**{sum(one['jerks'] for one in found)}** (if none, upper 95 % bound {3 / max(steps, 1):.1e})."
    ]


def _class_table(totals: dict[str, Row]) -> list[str]:
    head = ("class", "limits", "steps", "above", f"steps above {USED:.0%} of the limit", "largest share of the limit")
    head += ("steps near the person", "largest share of the jerk limit", "safe / modified / relaxed / stopped / fault")
    return markdown_table(head, [_class_cells(kind, totals) for kind in COMPLETE_CLASSES if kind.name in totals])


def _class_cells(kind: SpeedClass, totals: dict[str, Row]) -> tuple[object, ...]:
    one = totals[kind.name]
    return (
        kind.name,
        kind.description,
        f"{one['steps']:.3g}",
        one["above"],
        f"{one['used'] / one['steps']:.1%}",
        f"{one['largest']:.5f}",
        f"{one['near'] / one['steps']:.1%}" if kind.near else "",
        f"{one['jerk']:.5f}" if kind.judges_jerk else "",
        " / ".join(f"{one[name] / one['steps']:.2%}" for name in STATUSES),
    )


def _control_table(totals: dict[str, Row]) -> list[str]:
    head = ("negative control", "removed element", "steps", "above", "jerk limit exceeded", "largest share", "verdict")
    return markdown_table(head, [_control_cells(kind, totals) for kind in NEGATIVE_CONTROLS if kind.name in totals])


def _control_cells(kind: SpeedClass, totals: dict[str, Row]) -> tuple[object, ...]:
    one = totals[kind.name]
    fails = one["above"] + one["jerks"] > 0
    verdict = "fails, as expected" if fails else "holds: the adversary is too weak"
    largest = max(one["largest"], one["jerk"])
    return (kind.name, kind.description, f"{one['steps']:.3g}", one["above"], one["jerks"], f"{largest:.3g}", verdict)
