"""Parts of trials: the Panda with few spheres, and a tool that pushes in one direction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.differential_drive import integrate_configuration
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import FilterConfig, PythonBarrier, SafetyFilter

Array = NDArray[np.float64]

EXACT_TRACKING = FilterConfig(lag_compensation=False, tracking_error=0.0)
"""For closed loops in which ẏ = u holds exactly."""


@cache
def sparse_panda() -> RobotModel:
    """The Panda with every fourth sphere: the same kinematics, a quarter of the work."""
    robot_model = load_robot("panda")
    return msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::4])


def sparse_panda_filter(config: FilterConfig = EXACT_TRACKING, barriers: Sequence[PythonBarrier] = ()) -> SafetyFilter:
    """A filter for that arm."""
    return SafetyFilter(sparse_panda(), config, barriers=barriers)


def tool_push(safety: SafetyFilter, direction: Sequence[float], speed: float = 0.4) -> Callable[[Array], Array]:
    """u_nom(q) that moves the tool along `direction` (3,) at `speed` [m/s] without turning it."""
    twist = np.concatenate([speed * np.asarray(direction, float), np.zeros(3)])

    def push(q: Array) -> Array:
        J = safety.tool(q).jacobian
        return J.T @ np.linalg.solve(J @ J.T + 1e-3 * np.eye(6), twist)

    return push


def moving_spheres(safety: SafetyFilter, q: Array, opening: float = 0.0) -> tuple[Array, Array]:
    """Centres (k, 3) and radii (k,) of the spheres that move."""
    where, radii, _ = safety.spheres(q, opening)
    fixed = sum(sphere.link == "link0" for sphere in safety.robot_model.spheres)
    return where[fixed:], radii[fixed:]


def integrate(robot_model: RobotModel, q: Array, u: Array) -> Array:
    """The configuration one period later, ẏ = u exactly."""
    return (
        integrate_configuration(q, u, robot_model.period)
        if robot_model.base == "differential"
        else q + robot_model.period * u
    )


def home_posture(safety: SafetyFilter) -> Array:
    """The resting posture (n,) [rad]."""
    return np.array(safety.robot_model.home)
