"""The robot model of an arm in an environment, made from the MuJoCo model of that environment.

The chain, the joint limits and the shapes are those of the simulation, so the model fits the installed version.
A mesh counts as its convex hull, because MuJoCo collides with that; a body without colliding geoms counts as its drawn
ones. Only the bodies from the base to the first joint of the arm, and everything that this joint carries, are read.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco

from dualbrain.core.geometry.validation import check_positive
from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.meshes import Mesh, convex_hull_mesh
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
from dualbrain.robots.importer.kinematic_tree import KinematicTree, LinkShape, encode_tree
from dualbrain.robots.importer.required_limits import LimitPolicy, StatedLimit
from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.derating import MAX_PERIOD
from dualbrain.simulation.environments.mujoco_arm import carried_bodies, find_id
from dualbrain.simulation.models.mjcf_reader import tree_of_model

WEIGHTS = {"base": 0.15, "arm": 0.4, "hand": 1.6, "fingers": 2.5}
"""Weight of the excess by link group: the fingers are near obstacles in every task, the base never."""
SPHERE_BUDGET = 128


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmLimits:
    """Limits that no MJCF states: of every joint [rad/s], [rad/s²], of the tool [m/s]; and the filter's period [s].

    The period is at most `MAX_PERIOD`, 10 ms, and divides the time of one step of the environment.
    """

    velocity: float
    acceleration: float
    tool_speed: float
    period: float

    def __post_init__(self) -> None:
        """Check the limits; raises `ConfigurationError`."""
        for name, unit in (("velocity", "rad/s"), ("acceleration", "rad/s²"), ("tool_speed", "m/s")):
            check_positive(f"ArmLimits.{name} [{unit}]", getattr(self, name))
        if not 0.0 < self.period <= MAX_PERIOD:
            allowed = f"above 0, at most {MAX_PERIOD}"
            raise ConfigurationError("ArmLimits.period [s]", got=self.period, allowed=allowed)


_MADE: dict[str, RobotModel] = {}
"""The models made in this process, by the digest of all that they are made from."""


def make_arm_model(
    model: Any, data: Any, name: str, *, base: str, tool: str, joints: Sequence[str], limits: ArmLimits
) -> RobotModel:
    """The robot model `name` of the arm from the body `base` to the body `tool`, whose frame is the tool frame.

    `model` and `data` are those of MuJoCo. Joints between `base` and `tool` that are not among `joints` count as fixed
    at their present position. The fit of the spheres takes seconds, once per process.

    Raises:
        UnknownNameError: the MuJoCo model has no body or joint of a name.
        ConfigurationError: `tool` is not carried by `base`, or the arm does not fit the filter.
        MissingDependencyError: the extra `simulation` is not installed.
    """
    path = _path(model, base, tool)
    first = int(model.jnt_bodyid[find_id(model, mujoco.mjtObj.mjOBJ_JOINT, "joint", joints[0])])
    bodies = [*(body for body in path if body < first), *sorted(carried_bodies(model, first))]
    tree = tree_of_model(model, name, "the MuJoCo model of the environment", bodies)
    options = ImportOptions(
        name=name,
        base=base,
        tip=tool,
        tool=tool,
        lock=_other_joints(model, data, path[1:], joints),
        quick=True,
        sphere_budget=SPHERE_BUDGET,
        weights=WEIGHTS,
    )
    key = hashlib.sha256(encode_tree(tree) + repr((options, limits)).encode()).hexdigest()
    if key not in _MADE:
        _MADE[key] = build_arm(_with_hulls(tree), _policy(name, limits), options).robot_model
    return _MADE[key]


def _path(model: Any, base: str, tool: str) -> list[int]:
    """The bodies from `base` to `tool`."""
    start, body = (find_id(model, mujoco.mjtObj.mjOBJ_BODY, "body", name) for name in (base, tool))
    path = [body]
    while path[-1] != start:
        if path[-1] == 0:
            raise ConfigurationError.stating(
                f"The body {tool!r} is not carried by the body {base!r}.", fix="Name the base of the arm of the tool."
            )
        path.append(int(model.body_parentid[path[-1]]))
    return path[::-1]


def _other_joints(model: Any, data: Any, path: Sequence[int], joints: Sequence[str]) -> dict[str, float]:
    """The present positions, to 0.1 mm, of the joints on `path` that are no joints of the arm."""
    return {
        model.joint(j).name: round(float(data.qpos[model.jnt_qposadr[j]]), 4)
        for j in range(model.njnt)
        if int(model.jnt_bodyid[j]) in path and model.joint(j).name not in joints
    }


def _policy(name: str, limits: ArmLimits) -> LimitPolicy:
    where = f"site policy for {name}: its MJCF states no limit"
    velocity, acceleration, speed, period = (
        StatedLimit(value, where) for value in (limits.velocity, limits.acceleration, limits.tool_speed, limits.period)
    )
    return LimitPolicy(
        all_joints={"velocity": velocity, "acceleration": acceleration},
        robot={"tool_speed": speed, "period": period},
    )


def _with_hulls(tree: KinematicTree) -> KinematicTree:
    """`tree` with the convex hull of every shape."""
    links = {name: replace(link, shapes=tuple(map(_hull, link.shapes))) for name, link in tree.links.items()}
    return replace(tree, links=links)


def _hull(shape: LinkShape) -> LinkShape:
    return LinkShape(shape.label, partial(_load_hull, shape))


def _load_hull(shape: LinkShape) -> Mesh:
    return convex_hull_mesh(shape.load_mesh().vertices)
