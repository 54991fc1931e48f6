"""Excitation signals for identification: sums of sines, bang-bang, and full speed towards the nearest barrier.

All signals pass the safety filter, so that velocity, acceleration and joint limits are those of operation. The filter
uses a fixed assumed tracking model, so that the result does not depend on an earlier identification.
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
"""Lag [s] and position error [rad] that the filter assumes before identification."""


class IdentifiablePlant(Protocol):
    """A plant that can be identified: `measure()` updates `q` and `v` (n,), `apply(u)` drives for one control period.

    A mobile manipulator has q (n + 1,), and also `path` (n,), the displacement along each control.
    """

    q: Array
    v: Array

    def measure(self) -> None:
        """Update `q` and `v`."""
        ...

    def apply(self, u: Array) -> None:
        """Drive at u (n,) [rad/s] for one control period."""
        ...


class ExcitationLog(msgspec.Struct, frozen=True, eq=False):
    """Positions (or paths) and velocities before each control period and the control in it, each (n_periods, n)."""

    q: Array
    v: Array
    u: Array


def excite(
    plant: IdentifiablePlant, robot_model: RobotModel, kind: str, steps: int, rng: np.random.Generator
) -> ExcitationLog:
    """Drive `plant` for `steps` control periods with the excitation `kind` through the filter, and return the log."""
    assumed = TrackingErrorModel(
        lag=ASSUMED_LAG,
        position_error=ASSUMED_ERROR,
        rate=robot_model.alpha,
        provenance="assumed before identification",
    )
    safety = SafetyFilter(msgspec.structs.replace(robot_model, tracking=assumed), FilterConfig())
    parts = tuple(sorted({link.group for link in robot_model.links} - {BASE_GROUP})) if robot_model.is_mobile else ()
    safety.observe([Obstacle("floor", HalfSpace(), Pose((0.0, 0.0, 0.0)), parts=parts)], 0.0)
    signal = _SIGNALS[kind](robot_model, rng)
    q, v, u = (np.empty((steps, robot_model.n)) for _ in range(3))
    for t in range(steps):
        plant.measure()
        q[t], v[t] = getattr(plant, "path", plant.q), plant.v
        u[t] = safety(plant.q, v[t], signal(t, safety)).u
        plant.apply(u[t])
    return ExcitationLog(q, v, u)


ExcitationSignal = Callable[[int, SafetyFilter], Array]
"""The nominal joint velocity (n,) [rad/s] in control period t."""


def _sines(robot_model: RobotModel, rng: np.random.Generator) -> ExcitationSignal:
    """Three sines per joint between 0.1 and 3 Hz, whose sum stays within the velocity limit."""
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    rate = 2.0 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(3.0), (3, robot_model.n)))
    phase, share = rng.uniform(0.0, 2.0 * np.pi, (3, robot_model.n)), rng.dirichlet(np.ones(3), robot_model.n).T
    return lambda t, _: v_max * np.sum(share * np.sin(rate * (t * robot_model.period) + phase), axis=0)


def _bang_bang(robot_model: RobotModel, rng: np.random.Generator) -> ExcitationSignal:
    """Full speed of every joint in a random direction, which changes after 0.15 to 1 s."""
    return _hold_random(robot_model, rng, lambda _: None)


def _rows(robot_model: RobotModel, rng: np.random.Generator) -> ExcitationSignal:
    """Full speed towards the barrier with the smallest h, along its row."""
    return _hold_random(robot_model, rng, _nearest_row)


def _hold_random(
    robot_model: RobotModel, rng: np.random.Generator, aim: Callable[[SafetyFilter], Array | None]
) -> ExcitationSignal:
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    until, held = 0, np.zeros(robot_model.n)

    def signal(t: int, safety: SafetyFilter) -> Array:
        nonlocal until, held
        if t >= until:
            random_signs, row = np.where(rng.random(robot_model.n) < 0.5, -1.0, 1.0), aim(safety)
            signs = random_signs if row is None or rng.random() < 0.1 else np.where(row > 0.0, -1.0, 1.0)
            until, held = t + int(rng.integers(150, 1000)), signs * v_max
        return held

    return signal


def _nearest_row(safety: SafetyFilter) -> Array | None:
    rows = safety.rows()
    return min(rows, key=lambda row: row.h).a if rows else None


_SIGNALS: dict[str, Callable[[RobotModel, np.random.Generator], ExcitationSignal]] = {
    "sines": _sines,
    "bang_bang": _bang_bang,
    "rows": _rows,
}

EXCITATION_KINDS = tuple(_SIGNALS)
