"""Limits of the speed of all parts and of the jerk of the joints in at least 1e7 worst-case steps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.safety.speed_limits.classes import CLASSES, COMPLETE_CLASSES, HELD, NEGATIVE_CONTROLS, SpeedClass
from experiments.safety.speed_limits.point_speeds import Array, PointSpeeds
from experiments.safety.speed_limits.tables import USED, speed_tables
from experiments.safety.speed_limits.trial import PERSON, STATUSES, load_arm, make_trial

EPISODES_PER_UNIT, STEPS_PER_EPISODE = 10, 10_000
BLOCKS, CONTROL_BLOCKS = 11, 2
CHUNK = 2000
"""Number of states that are judged at once."""
NEAR_ROUNDING, JERK_ROUNDING = 1e-4, 1e-3
"""Distance [m] that single precision leaves undecided at the edge of the person's distance, and share of the jerk."""
SUMMED = ("steps", "above", "unreported", "jerks", "used", "near", *STATUSES)


class SpeedLimits:
    """Limits of speed and jerk against an adversary, by a judge in float64 that shares no code with the filter."""

    name = "speed_limits"
    claim = (
        "In at least 1e7 adversarial steps of Panda and UR5e, also while the arm evades an obstacle, no part, also of "
        "a grasped object, is faster than the limit of the filter or, near a person, of the site, unless the filter "
        "reports that it found no control that keeps the limit (OVERSPEED); no joint exceeds its jerk limit; each "
        "negative control fails."
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
        above = f"above on {row['above']} of {row['steps']} steps, {row['unreported']} of them unreported"
        return f"{above}, at most {row['largest']:.4f} of the limit"

    def report(self, rows: list[Row]) -> list[str]:
        """The verdict, the classes, and the negative controls."""
        totals = {
            name: aggregate(group) for name in CLASSES if (group := [one for one in rows if one["class"] == name])
        }
        return speed_tables(totals)


def run_episode(kind: SpeedClass, seed: int, steps: int = STEPS_PER_EPISODE) -> Row:
    """The counts of one random scene and start posture."""
    trial = make_trial(kind, seed)
    q, u, counts = trial.run(steps)
    above, row = _judged(kind, q, u, trial.person)
    unreported = [step for step in above if not (kind.compared_with or trial.reports_overspeed(step))]
    return row | counts | {"unreported": len(unreported)}


def aggregate(counts: Iterable[Row]) -> Row:
    """Sums and maxima of the counts of several episodes."""
    group = list(counts)
    sums = {name: sum(one[name] for one in group) for name in SUMMED}
    return sums | {name: max(one[name] for one in group) for name in ("largest", "jerk")}


def _judged(kind: SpeedClass, q: Array, u: Array, person: Obstacle | None) -> tuple[list[int], Row]:
    """The steps with a part above its limit, and counts of steps.

    Steps above a limit or near it, the largest share of a limit, and steps with a part near the person.
    """
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
    above = [int(step) for step in np.flatnonzero(share > 1.0)]
    return above, {
        "steps": len(q),
        "above": len(above),
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
