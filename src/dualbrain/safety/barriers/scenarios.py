"""Building blocks of barrier scenarios: a Panda with few spheres, and nominal controls that push the tool."""

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
"""Filter configuration for closed loops in which ẏ = u holds exactly."""


@cache
def sparse_panda() -> RobotModel:
    """The Panda with every fourth collision sphere: the same kinematics at a quarter of the cost."""
    robot_model = load_robot("panda")
    return msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::4])


def sparse_panda_filter(config: FilterConfig = EXACT_TRACKING, barriers: Sequence[PythonBarrier] = ()) -> SafetyFilter:
    """A safety filter of `sparse_panda`."""
    return SafetyFilter(sparse_panda(), config, barriers=barriers)


def tool_push(safety: SafetyFilter, direction: Sequence[float], speed: float = 0.4) -> Callable[[Array], Array]:
    """Nominal control u_nom(q) (n,) that translates the tool along `direction` (3,) at `speed` [m/s]."""
    twist = np.concatenate([speed * np.asarray(direction, float), np.zeros(3)])

    def push(q: Array) -> Array:
        J = safety.tool(q).jacobian
        return J.T @ np.linalg.solve(J @ J.T + 1e-3 * np.eye(6), twist)

    return push


def moving_spheres(safety: SafetyFilter, q: Array, opening: float = 0.0) -> tuple[Array, Array]:
    """Centres (k, 3) [m] and radii (k,) [m] of the spheres that move: all spheres but those of link0."""
    centres, radii, _ = safety.spheres(q, opening)
    fixed = sum(sphere.link == "link0" for sphere in safety.robot_model.spheres)
    return centres[fixed:], radii[fixed:]


def integrate(robot_model: RobotModel, q: Array, u: Array) -> Array:
    """The configuration after one control period with ẏ = u exactly."""
    return (
        integrate_configuration(q, u, robot_model.period)
        if robot_model.base == "differential"
        else q + robot_model.period * u
    )


def home_posture(safety: SafetyFilter) -> Array:
    """The home posture of the robot model (n,) [rad]."""
    return np.array(safety.robot_model.home)
