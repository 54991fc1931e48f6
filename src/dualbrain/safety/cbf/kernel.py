"""Conversion of a `RobotModel` and of obstacles to the input of the compiled kernel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from struct import Struct
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix, rotation_entries
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace
from dualbrain.core.geometry.validation import check_array
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.collision_model.opening_hull import opening_hull
from dualbrain.robots.model import Joint, RobotModel
from dualbrain.safety.cbf.compiled import _kernel
from dualbrain.safety.cbf.compiled._kernel import Kernel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import FilterResult, FilterStatus

Array = NDArray[np.float64]

MAX_OBSTACLES: int = _kernel.max_obstacles
"""Most obstacles in the obstacle table."""
BUILD_SUFFIXES = ("", "_wide")
"""Suffixes of the builds by size: up to 8 joints and up to 16 joints."""
CAPSULE, BOX, HALF_SPACE = 0.0, 1.0, 2.0
KNOWN_FLAG, STATIC_FLAG = 1, 2
BASE_JOINTS = 2
"""Joints of a mobile base in the chain: speeds of a mobile manipulator are relative to the mount of its arm."""
ALL_PARTS = 2**32 - 1
OBSTACLE_COLUMNS = 29
_pack_entry = Struct(f"{OBSTACLE_COLUMNS}d").pack
"""The entry of one obstacle as bytes: numpy takes three times as long for a list of tuples."""
UNUSABLE_TABLE: Array = np.full((1, OBSTACLE_COLUMNS), np.nan)
"""Obstacle table that the kernel rejects: every step stops the robot (`Reason.BAD_SCENE`) until the next table."""
UNLIMITED_ACCELERATION = 1e4
"""Acceleration [rad/s²] that never binds; used without acceleration limits."""


def kernel_hash() -> str:
    """First 16 hexadecimal digits of the SHA-256 over the kernel's sources and compiler flags."""
    return _kernel.source_hash


def make_kernel(robot_model: RobotModel, config: FilterConfig, weight: ArrayLike | None = None) -> Kernel:
    """A kernel for `robot_model`; `weight` is R (n, n), symmetric positive definite, by default diag(1/v_max²).

    Raises:
        ConfigurationError: no build has room for the robot model, or a limit or the weight cannot be used.
    """
    kernel = select_build(robot_model, config).Kernel(kernel_model(robot_model, config, weight))
    kernel.set_result_type(FilterResult, tuple(FilterStatus))
    return kernel


class KernelBuild(Protocol):
    """One compiled build of the kernel, and its capacity."""

    max_joints: int
    max_spheres: int
    max_links: int
    max_pairs: int

    @property
    def Kernel(self) -> type[Kernel]:  # noqa: N802  (a class)
        """The kernel class of this build; the classes of all builds behave alike."""
        ...


def select_build(robot_model: RobotModel, config: FilterConfig) -> KernelBuild:
    """The smallest build with room for `robot_model` in the configured number type; most arms fit the first.

    Both sizes are compiled from the same sources and return the same bits; the large build is slower.

    Raises:
        ConfigurationError: no build has room; the message names the quantity that exceeds the capacity.
    """
    lacking: list[tuple[str, int, int]] = []
    for name in BUILD_SUFFIXES:
        build = _load_build(f"_kernel{'64' if config.precision == 'float64' else ''}{name}")
        lacking = [(what, got, room) for what, got, room in _required_sizes(robot_model, build) if got > room]
        if not lacking:
            return build
    what, got, room = lacking[0]
    raise ConfigurationError(f"{what} of the robot model", got=got, allowed=f"at most {room}")


def _load_build(name: str) -> KernelBuild:
    """Import a build on first use."""
    return _kernel if name == "_kernel" else cast(KernelBuild, import_module(f"dualbrain.safety.cbf.compiled.{name}"))


def _required_sizes(robot_model: RobotModel, build: KernelBuild) -> tuple[tuple[str, int, int], ...]:
    """Name, size in `robot_model` and capacity of `build` for every quantity with a limit."""
    return (
        ("joints", robot_model.n, build.max_joints),
        ("spheres", len(robot_model.spheres), build.max_spheres),
        ("parts", len(robot_model.links), build.max_links),
        ("pairs kept apart", len(robot_model.self_pairs.kept), build.max_pairs),
    )


def kernel_model(robot_model: RobotModel, config: FilterConfig, weight: ArrayLike | None = None) -> dict[str, Any]:
    """The kernel's model of `robot_model`; lengths and angles are in float64, and the kernel rounds once."""
    return (
        _settings(robot_model, config)
        | _joint_limits(robot_model, config, weight)
        | _geometry(robot_model)
        | _opening_range(robot_model)
        | _self_collision_pairs(robot_model)
    )


def _settings(robot_model: RobotModel, config: FilterConfig) -> dict[str, Any]:
    return {
        "n": robot_model.n,
        "period": robot_model.period,
        "alpha": _row_gain(robot_model, config, config.alpha),
        "alpha_self": _row_gain(robot_model, config, config.alpha_self),
        "alpha_joint": _row_gain(robot_model, config, config.alpha_joint),
        "recovery": config.recovery_speed,
        "sampling": config.sampling_margin,
        "rounding": config.rounding_margin,
        "self_margin": config.self_margin,
        "lag": robot_model.tracking.lag if config.lag_compensation else 0.0,
        "speed_limit": config.cartesian_speed or 0.0,
        "moving_base": float(robot_model.is_mobile),
        "speed_first_joint": float(BASE_JOINTS if robot_model.is_mobile_manipulator else 0),
        "state_age_max": config.state_stale_after,
        "scene_age_max": config.scene_stale_after,
    }


def tracking_errors(robot_model: RobotModel, config: FilterConfig) -> Array:
    """Tracking margin (n,) of each joint for ẏ ≠ u [rad/s]: the configured one, or the model's at the largest gain.

    Raises:
        ConfigurationError: `FilterConfig.tracking_error` has another number of entries than the robot has joints.
    """
    n, given = robot_model.n, config.tracking_error
    if given is None:
        return np.array(robot_model.tracking.row_margins(max_gain(robot_model, config), n))
    if isinstance(given, tuple) and len(given) != n:
        allowed = f"one number, or {n} for the joints of {robot_model.name}"
        raise ConfigurationError("FilterConfig.tracking_error [rad/s]", got=f"{len(given)} numbers", allowed=allowed)
    return np.broadcast_to(np.asarray(given, float), (n,)).copy()


def max_gain(robot_model: RobotModel, config: FilterConfig) -> float:
    """The largest gain α [1/s] of the filter's rows, without gains of single obstacles."""
    return max(_row_gain(robot_model, config, gain) for gain in (config.alpha, config.alpha_self, config.alpha_joint))


def _row_gain(robot_model: RobotModel, config: FilterConfig, own: float | None) -> float:
    """The gain of one kind of row: `own`, else `FilterConfig.alpha`, else the largest that braking can follow."""
    if own is not None:
        return own
    return robot_model.alpha if config.alpha is None else config.alpha


def _joint_limits(robot_model: RobotModel, config: FilterConfig, weight: ArrayLike | None) -> dict[str, Any]:
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    a_max = np.array([joint.acceleration.value for joint in robot_model.joints])
    n = robot_model.n
    R = np.diag(1.0 / v_max**2) if weight is None else check_array("weight R of the filter", weight, (n, n), 1e12)
    try:
        scale = np.linalg.inv(np.linalg.cholesky(R)).T
    except np.linalg.LinAlgError:
        raise ConfigurationError(
            "weight R of the filter", got=R.tolist(), allowed="symmetric positive definite"
        ) from None
    return {
        "q_lower": np.array([joint.lower.value for joint in robot_model.joints]),
        "q_upper": np.array([joint.upper.value for joint in robot_model.joints]),
        "v_max": v_max,
        "a_max": a_max if config.acceleration_limits else np.full(robot_model.n, UNLIMITED_ACCELERATION),
        "tracking": tracking_errors(robot_model, config),
        "j_max": np.array([_jerk_limit(joint) if config.jerk_limits else 0.0 for joint in robot_model.joints]),
        "scale": np.ascontiguousarray(scale),
    }


def _jerk_limit(joint: Joint) -> float:
    if joint.jerk is None:
        raise ConfigurationError.stating(
            f"The robot model has no jerk limit for {joint.name}.",
            fix="Add a jerk bound for every joint, or set FilterConfig.jerk_limits to False.",
        )
    return joint.jerk.value


def _geometry(robot_model: RobotModel) -> dict[str, Any]:
    counts = [sum(sphere.link == link.name for sphere in robot_model.spheres) for link in robot_model.links]
    first = [0, *np.cumsum(counts).tolist()]
    rotation, offset = tool_frame(robot_model)
    return {
        "joint_kind": np.array([float(joint.kind == "prismatic") for joint in robot_model.joints]),
        "joint_rotation": np.concatenate(
            [quaternion_to_matrix(joint.quaternion).ravel() for joint in robot_model.joints]
        ),
        "joint_offset": np.concatenate([np.array(joint.translation) for joint in robot_model.joints]),
        "tool_rotation": np.ascontiguousarray(rotation),
        "tool_offset": offset,
        "link_frame": np.array([float(link.frame) for link in robot_model.links]),
        "link_first": np.array(first, float),
        "spheres": _sphere_rows(robot_model),
    }


def _sphere_rows(robot_model: RobotModel) -> Array:
    """Spheres (k, 7) in the order of the links: centre and radius in the frame of the link, and slide."""
    rows: list[Array] = []
    for link in robot_model.links:
        turn, shift = quaternion_to_matrix(link.quaternion), np.array(link.translation)
        slide = turn @ np.array(link.slide)
        for sphere in robot_model.spheres:
            if sphere.link == link.name:
                rows.append(np.array([*(shift + turn @ np.array(sphere.centre)), sphere.radius, *slide]))
    return np.array(rows, float).reshape(-1, 7)


def _opening_range(robot_model: RobotModel) -> dict[str, Any]:
    """The largest finger opening [m], and spheres that cover the fingers at every opening; nothing without fingers."""
    hull = opening_hull(robot_model)
    if hull is robot_model:
        return {}
    return {"opening_max": robot_model.gripper.opening.value, "hull_spheres": _sphere_rows(hull)}


def tool_frame(robot_model: RobotModel) -> tuple[Array, Array]:
    """Rotation (3, 3) and offset (3,) [m] of the tool in the last frame of the chain.

    Raises:
        ConfigurationError: the link of the tool is not on the last frame.
    """
    link = next(link for link in robot_model.links if link.name == robot_model.tool.link)
    if link.frame != robot_model.n:
        raise ConfigurationError(
            "link of the tool", got=link.name, allowed=f"a link on the last frame ({robot_model.n})"
        )
    turn = quaternion_to_matrix(link.quaternion)
    offset = np.array(link.translation) + turn @ np.array(robot_model.tool.translation)
    return turn @ quaternion_to_matrix(robot_model.tool.quaternion), offset


def _self_collision_pairs(robot_model: RobotModel) -> dict[str, Any]:
    """Kept link pairs, the link nearer to the base first, and the links that a grasped object keeps away from.

    A grasped object keeps away from the same links as the hand.
    """
    index = {link.name: i for i, link in enumerate(robot_model.links)}
    pairs: list[tuple[int, int]] = []
    held: set[int] = set()
    for names in robot_model.self_pairs.kept:
        near, far = sorted((index[name] for name in names), key=lambda i: robot_model.links[i].frame)
        if robot_model.links[near].frame == robot_model.links[far].frame:
            raise ConfigurationError(
                "self-collision pair", got=names, allowed="two links that move relative to each other"
            )
        pairs.append((near, far))
        if robot_model.links[far].group in ("hand", "fingers"):
            held.add(near)
    return {
        "pairs": np.array(pairs, float).reshape(-1),
        "held_links": np.array(sorted(held), float),
    }


def obstacle_table(obstacles: Sequence[Obstacle], parts: Mapping[str, Sequence[int]] | None = None) -> Array:
    """Input table (k, 29) of the kernel for usable `obstacles` (`check_obstacles`).

    `parts` maps the name of each robot part to its link indices.

    Raises:
        ConfigurationError: there are more obstacles than `MAX_OBSTACLES`.
        UnknownNameError: an obstacle names a part that is not in `parts`.
    """
    if len(obstacles) > MAX_OBSTACLES:
        raise ConfigurationError("obstacles at once", got=len(obstacles), allowed=f"at most {MAX_OBSTACLES}")
    entries = [_pack_entry(*_obstacle_entry(obstacle, parts or {})) for obstacle in obstacles]
    return np.frombuffer(bytearray().join(entries), float).reshape(-1, OBSTACLE_COLUMNS)


def _obstacle_entry(obstacle: Obstacle, parts: Mapping[str, Sequence[int]]) -> tuple[float, ...]:
    shape, pose = obstacle.shape, obstacle.pose
    half, r = (0.0, 0.0, 0.0), 0.0
    if isinstance(shape, Box):
        kind, half = BOX, shape.half_extents
    elif isinstance(shape, HalfSpace):
        kind = HALF_SPACE
    else:
        kind, r = CAPSULE, shape.radius
        half = (0.0, 0.0, shape.half_length) if isinstance(shape, Capsule) else half
    monitoring = obstacle.separation
    separation = (monitoring.reaction, monitoring.brake, monitoring.approach) if monitoring else (0.0, 0.0, 0.0)
    return (
        kind,
        KNOWN_FLAG * obstacle.known + STATIC_FLAG * obstacle.static,
        obstacle.rank,
        _part_mask(obstacle.parts, parts) if obstacle.parts else ALL_PARTS,
        obstacle.alpha or 0.0,
        *pose.position,
        *rotation_entries(pose.quaternion),
        *half,
        r,
        *obstacle.velocity,
        obstacle.margin,
        obstacle.velocity_error,
        *separation,
    )


def _part_mask(names: Sequence[str], parts: Mapping[str, Sequence[int]]) -> float:
    """Bit mask of the links that keep away from an obstacle."""
    for name in names:
        if name not in parts:
            raise UnknownNameError("part of the robot", name, tuple(parts))
    return float(sum(1 << link for link in {link for name in names for link in parts[name]}))
