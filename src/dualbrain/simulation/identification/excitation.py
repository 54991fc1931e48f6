"""What a plant is driven with to learn how it follows: sums of sines, bang-bang, full speed down the nearest row.

All of it goes through the filter, so that velocity, acceleration and joint limits are those of operation; the filter
assumes a lag and an error of its own here, so that nothing that was identified before enters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.robots.mobile_manipulator import BASE_GROUP
from dualbrain.robots.model import RobotModel, TrackingErrorModel
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter

Array = NDArray[np.float64]

ASSUMED_LAG, ASSUMED_ERROR = 0.002, 0.006
"""Lag [s] and position error [rad] that the filter allows for while nothing is known."""


class IdentifiablePlant(Protocol):
    """What can be identified: `sense()` refreshes `q` and `v` (n,), `act(u)` drives for one control period.

    What drives has q (n + 1,), and beside it a `path` (n,): how far each control has moved it.
    """

    q: Array
    v: Array

    def measure(self) -> None:
        """Measure."""
        ...

    def apply(self, u: Array) -> None:
        """Drive at u (n,) [rad/s]."""
        ...


class ExcitationLog(msgspec.Struct, frozen=True, eq=False):
    """Joint positions (or paths) and velocities before each control period and the control sent in it, each (t, n)."""

    q: Array
    v: Array
    u: Array


def excite(
    plant: IdentifiablePlant, robot_model: RobotModel, kind: str, steps: int, rng: np.random.Generator
) -> ExcitationLog:
    """Drive `plant` for `steps` periods by one kind of excitation, through the filter; what it did."""
    assumed = TrackingErrorModel(
        lag=ASSUMED_LAG,
        position_error=ASSUMED_ERROR,
        rate=robot_model.alpha,
        provenance="assumed while nothing is known",
    )
    safety = SafetyFilter(msgspec.structs.replace(robot_model, tracking=assumed), FilterConfig())
    parts = tuple(sorted({link.group for link in robot_model.links} - {BASE_GROUP})) if robot_model.is_mobile else ()
    safety.observe([Obstacle("floor", HalfSpace(), Pose((0.0, 0.0, 0.0)), parts=parts)], 0.0)
    wish = _SIGNALS[kind](robot_model, rng)
    q, v, u = (np.empty((steps, robot_model.n)) for _ in range(3))
    for t in range(steps):
        plant.measure()
        q[t], v[t] = getattr(plant, "path", plant.q), plant.v
        u[t] = safety(plant.q, v[t], wish(t, safety)).u
        plant.apply(u[t])
    return ExcitationLog(q, v, u)


ExcitationSignal = Callable[[int, SafetyFilter], Array]
"""What is wished, a joint velocity (n,), in period t."""


def _sines(robot_model: RobotModel, rng: np.random.Generator) -> ExcitationSignal:
    """Three sines a joint between 0.1 and 3 Hz, together at most the velocity limit."""
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    pace = 2.0 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(3.0), (3, robot_model.n)))
    phase, share = rng.uniform(0.0, 2.0 * np.pi, (3, robot_model.n)), rng.dirichlet(np.ones(3), robot_model.n).T
    return lambda t, _: v_max * np.sum(share * np.sin(pace * (t * robot_model.period) + phase), axis=0)


def _bang_bang(robot_model: RobotModel, rng: np.random.Generator) -> ExcitationSignal:
    """Full speed of every joint either way, changed after 0.15 to 1 s."""
    return _hold_random(robot_model, rng, lambda _: None)


def _rows(robot_model: RobotModel, rng: np.random.Generator) -> ExcitationSignal:
    """Full speed down the row with the smallest h."""
    return _hold_random(robot_model, rng, _nearest_row)


def _hold_random(
    robot_model: RobotModel, rng: np.random.Generator, aim: Callable[[SafetyFilter], Array | None]
) -> ExcitationSignal:
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    until, now = 0, np.zeros(robot_model.n)

    def wish(t: int, safety: SafetyFilter) -> Array:
        nonlocal until, now
        if t >= until:
            coins, row = np.where(rng.random(robot_model.n) < 0.5, -1.0, 1.0), aim(safety)
            signs = coins if row is None or rng.random() < 0.1 else np.where(row > 0.0, -1.0, 1.0)
            until, now = t + int(rng.integers(150, 1000)), signs * v_max
        return now

    return wish


def _nearest_row(safety: SafetyFilter) -> Array | None:
    rows = safety.rows()
    return min(rows, key=lambda row: row.h).a if rows else None


_SIGNALS: dict[str, Callable[[RobotModel, np.random.Generator], ExcitationSignal]] = {
    "sines": _sines,
    "bang_bang": _bang_bang,
    "rows": _rows,
}

EXCITATION_KINDS = tuple(_SIGNALS)
