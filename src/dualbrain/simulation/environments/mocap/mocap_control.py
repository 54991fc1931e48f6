"""The filter in front of an arm whose tool a MuJoCo mocap body drags through a weld, as in metaworld and Fetch.

An action displaces the mocap body. The guard computes the joint motion that carries the tool there, and returns the
displacement that belongs to the safe part of it. The weld leaves the null space of the arm and the lag of the tool
uncommanded. Therefore the computed configuration q_c is found again before every action, as the one nearest to the
measured joints at which the tool is at its commanded position, and the greatest distance d between a point of the arm
at q_c and at the measured joints is compared with a bound D, one for the hand and one for the other links, whose null
space is free. All obstacles are enlarged by D.

No action turns the tool, so the nearest safe control is of no use. A displacement that an obstacle limits is replaced
by the nearest one that the rows of the last step admit without a turn (`SafeTranslation`), and the guard brakes along
that path.

Guarantee: the computed links keep the distance D from every obstacle, and the measured ones stay off them as long as
d ≤ D. The bound is checked once per action, not in between. Beyond it the tool comes to rest where it was measured
then, and `info["safety"]` states it; the null space cannot be stopped by any action. Joint limits are left to the
simulation, because the null space reaches them without a command.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.core.geometry.validation import check_positive
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.safety.integration.policy_guard.action_layout import FunctionLayout, copy_as_floats
from dualbrain.safety.integration.policy_guard.tool_actions import ToolPose
from dualbrain.simulation.environments.guarded_mujoco_env import mujoco_handles
from dualbrain.simulation.environments.mocap.arm_model import ArmLimits, make_arm_model
from dualbrain.simulation.environments.mocap.safe_translation import SafeTranslation
from dualbrain.simulation.environments.mujoco_arm import MAX_LEVER_ERROR, MujocoArm, find_id
from dualbrain.simulation.environments.mujoco_obstacles import MujocoObstacles

Array = NDArray[np.float64]

IK_STEPS, IK_DAMPING = 12, 0.03
"""Steps and damping of the inverse kinematics from the measured joints."""
WIDER = 2.0
"""Addition to the range of each joint [rad] on both sides."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MocapControl:
    """How an environment moves its tool.

    `tool` is the body at the end of the weld, `base` the base of the arm, `joints` its joints. One unit of an action is
    a displacement of `scale` [m] from `reference`: the mocap body, or the tool. `rotation` (w, x, y, z), of any length,
    is that of the mocap body. `limits(env)` are the corners (2, 3) [m] of the box that bounds the mocap body.
    """

    tool: str
    base: str
    joints: tuple[str, ...]
    scale: float
    reference: Literal["mocap", "tool"]
    rotation: tuple[float, float, float, float]
    limits: Callable[[Any], Any] = lambda _: [[-np.inf] * 3, [np.inf] * 3]
    has_held_base: bool = False


def guard_mocap_env(
    env: Any,
    robot_model: RobotModel,
    control: MocapControl,
    *,
    ignored: Collection[str] = (),
    deviation: float = 0.02,
    arm_deviation: float | None = None,
    margin: float = 0.0,
) -> FilteredEnv:
    """`env`, which is reset once, with every displacement of its tool replaced by the closest safe one.

    `robot_model` has its tool frame at `control.tool`. Bodies in `ignored` are no obstacles. `deviation` [m] is the
    bound D of the distance between computed and measured links of the hand, which is all that moves with the last
    joint; `arm_deviation` [m] is that of the other links, by default the same. `margin` [m] is added to both.

    Raises:
        ConfigurationError: no MuJoCo simulation, another arm, or a time step that the period does not divide.
        UnknownNameError: the MuJoCo model has no joint or body of a name.
    """
    bounds = (deviation, deviation if arm_deviation is None else arm_deviation)
    for name, bound in zip(("deviation [m]", "arm_deviation [m]"), bounds, strict=True):
        check_positive(name, bound)
    env.reset()
    return MocapEnv(env, robot_model, control, tuple(ignored), bounds, margin)


def mocap_robot(env: Any, control: MocapControl, name: str, limits: ArmLimits) -> RobotModel:
    """The robot model `name` of the arm in `env`, which is reset once; `make_arm_model` states the errors."""
    env.reset()
    model, data = mujoco_handles(env)
    return make_arm_model(model, data, name, base=control.base, tool=control.tool, joints=control.joints, limits=limits)


class MocapEnv(FilteredEnv):
    """The environment behind the guard; `deviation` and `arm_deviation` [m] in `info` are d of hand and other links."""

    def __init__(
        self,
        env: Any,
        robot_model: RobotModel,
        control: MocapControl,
        ignored: Sequence[str],
        bounds: tuple[float, float],
        margin: float,
    ) -> None:
        """Compile the filter; `bounds` [m] are those of hand and arm, other parameters as for `guard_mocap_env`."""
        self._control, self._bounds, self._distances, self._has_new_path = control, bounds, (0.0, 0.0), False
        model, data = mujoco_handles(env)
        names = (robot_model, control.joints, control.base)
        self._arm = MujocoArm(model, data, *names, has_held_base=control.has_held_base)
        self._obstacles = MujocoObstacles(self._arm, ignored=ignored, margin=margin)
        self._parts = _hand_and_arm(robot_model)
        self._ghost = mujoco.MjData(model)
        self._tool = find_id(model, mujoco.mjtObj.mjOBJ_BODY, "body", control.tool)
        self._position, self._residual = data.xpos[self._tool].copy(), np.zeros(3)
        self._geoms = _geoms_of_hand_and_arm(self._arm)
        super().__init__(
            env,
            SafetyFilter(_without_joint_limits(robot_model), FilterConfig(lag_compensation=False, tracking_error=0.0)),
            state=lambda _: (self._arm.q, self._arm.v),
            scene=lambda _, __: self._enlarged_obstacles(),
            action_space=ToolPose(rotation="quaternion", layout=FunctionLayout(self._decode, self._encode)),
            deviation="along_path",
        )
        self._translation, self._is_held = SafeTranslation(self.safety, self.guard.steps_per_action), False
        self._rest_place: Array | None = None
        self._check_tool()

    def _check_tool(self) -> None:
        """Refuse a robot model whose tool frame is not at the body that the weld drags."""
        data, found = self._arm.data, self.safety.tool(self._arm.q)
        own = self._arm.to_base(data.xpos[self._tool], data.xmat[self._tool].reshape(3, 3))
        apart = float(np.linalg.norm(own[0] - found.position))
        turned = float(np.abs(own[1] - found.rotation).max())
        if apart > MAX_LEVER_ERROR or turned > MAX_LEVER_ERROR:
            raise ConfigurationError.stating(
                f"The tool frame of {self.safety.robot_model.name} is {apart * 1e3:.1f} mm from the body "
                f"{self._control.tool!r}, and its axes differ by {turned:.3g}.",
                fix=f"Import the robot with `dualbrain robot init --tool {self._control.tool}`.",
            )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and the guard."""
        result = super().reset(seed=seed, options=options)
        if mujoco_handles(self.env) != (self._arm.model, self._arm.data):
            raise ConfigurationError.stating(
                "The reset built another MuJoCo model.", fix="Guard the environment again after each such reset."
            )
        self._position = self._reference.copy()
        self._translation.reset()
        self._is_held, self._rest_place = False, None
        self.guard.reset(self._computed_joints(), 0.0)
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Filter and execute `action`; `info` has the distances of computed and measured links [m] before it."""
        observation, reward, terminated, truncated, info = super().step(action)
        hand, arm = self._distances
        info = {**info, "deviation": hand, "arm_deviation": arm}
        if self._has_new_path:
            info["safety"] = (
                f"an obstacle limits the displacement, and the tool takes the nearest other; {info['safety']}"
            )
            info["status"] = FilterStatus.MODIFIED.name if info["status"] == FilterStatus.SAFE.name else info["status"]
        return observation, reward, terminated, truncated, info

    def _guarded_action(self, action: Any) -> Any:
        q = self._computed_joints()
        self._distances = self._ghost_distances()
        self.guard.retarget(q)
        self.safety.observe(self._enlarged_obstacles(), self._now)
        v = self.guard.control if self._now else np.zeros(self._n)
        self._has_new_path = False
        usable, problem = self._read_action(action)
        if problem := problem or self._deviation_problem():
            self.guard.stop(problem, q, v, self._now)
            measured = self._arm.data.xpos[self._tool].copy()  # the arm may be unable to reach the commanded place
            place = self._rest_place = measured if self._rest_place is None else self._rest_place
            return self._encode_world(place, usable)
        self._rest_place = None
        held, proposed = self._position.copy(), self._without_approach(action, q)
        self._has_new_path = proposed is not action
        applied = self.guard(proposed, q, v, self._now)
        self._translation.read_rows()
        self._is_held = self.guard.report.speed_share == 0.0
        if self._is_held:  # the nearest control turns the tool or its elbow: no action does that
            self.safety.reset(0.0)
            return self._encode_world(held, action)
        if applied is proposed:
            self._position = self._target_position(proposed)
        return applied

    def _read_action(self, action: Any) -> tuple[Any, str]:
        """A copy of `action` with zero for each number that is not finite, and why it cannot be used, or ""."""
        space: Any = self.env.action_space
        problem = f"The action is not finite, or not of shape {space.shape}; the tool comes to rest. Remedy: check it"
        try:
            given = np.array(action, space.dtype)
        except (TypeError, ValueError):
            given = np.zeros(0)
        if given.shape != space.shape:
            return np.zeros(space.shape, space.dtype), problem
        return np.nan_to_num(given, posinf=0.0, neginf=0.0), "" if np.isfinite(given).all() else problem

    def _deviation_problem(self) -> str:
        """Why the tool comes to rest, or ""."""
        for name, distance, bound in zip(("hand", "arm"), self._distances, self._bounds, strict=True):
            if distance > bound:
                return (
                    f"A link of the {name} is {distance * 1e3:.0f} mm from its computed place, allowed are "
                    f"{bound * 1e3:.0f} mm; the tool comes to rest. Remedy: move more slowly (`derate`), "
                    f"look for a contact, or allow a larger `{'deviation' if name == 'hand' else 'arm_deviation'}`"
                )
        return ""

    def _without_approach(self, action: Any, q: Array) -> Any:
        """The action for the admitted displacement that is nearest to that of `action`, or `action` itself.

        A tool that holds its place takes the shortest way that leads away: with its acceleration limits it may not be
        able to begin another one.
        """
        wanted = self._position if self._is_held else self._target_position(action)
        turn = self._arm.data.xmat[self._arm.base].reshape(3, 3)
        shift = turn.T @ (wanted - self._position)
        nearest = self._translation.nearest(shift, self.safety.tool(q).jacobian)
        if nearest is None:
            return action
        replaced = copy_as_floats(action)
        replaced[:3] = np.clip((self._position + turn @ nearest - self._reference) / self._control.scale, -1.0, 1.0)
        return replaced

    def _enlarged_obstacles(self) -> list[Obstacle]:
        """The obstacles, enlarged by the bound of the links that keep away from them."""
        found = self._obstacles.observe()
        if self._bounds[0] == self._bounds[1]:
            return [msgspec.structs.replace(one, margin=one.margin + self._bounds[0]) for one in found]
        return [
            msgspec.structs.replace(one, name=f"{one.name} ({name})", margin=one.margin + bound, parts=parts)
            for name, bound, parts in zip(("hand", "arm"), self._bounds, self._parts, strict=True)
            for one in found
        ]

    # --- action and tool position ---------------------------------------------------------------------------------

    @property
    def _reference(self) -> Array:
        data = self._arm.data
        return data.mocap_pos[0] if self._control.reference == "mocap" else data.xpos[self._tool]

    def _target_position(self, action: Any) -> Array:
        low, high = np.asarray(self._control.limits(self.env.unwrapped), float)
        wanted = self._reference + self._control.scale * np.clip(np.asarray(action, float)[:3], -1.0, 1.0)
        return np.clip(wanted, low, high)

    def _decode(self, action: Any) -> Array:
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, self._rotation)
        position, turned = self._arm.to_base(self._target_position(action) + self._residual, rotation.reshape(3, 3))
        return np.concatenate([position, matrix_to_quaternion(turned)])

    def _encode(self, values: Array, action: Any) -> Any:
        turn, origin = self._arm.data.xmat[self._arm.base].reshape(3, 3), self._arm.data.xpos[self._arm.base]
        return self._encode_world(turn @ values[:3] + origin - self._residual, action)

    def _encode_world(self, position: Array, action: Any) -> Any:
        """The action that leads the tool to a position (3,) [m] in the world."""
        replaced = copy_as_floats(action)
        replaced[:3] = np.clip((position - self._reference) / self._control.scale, -1.0, 1.0)
        self._position = self._target_position(replaced)
        return replaced

    @property
    def _rotation(self) -> Array:
        given = np.array(self._control.rotation)
        return given / np.linalg.norm(given)

    # --- computed and measured links ------------------------------------------------------------------------------

    def _computed_joints(self) -> Array:
        """The configuration (n,) nearest to the measured one with the tool at its commanded pose.

        Near a stretched arm the tool stays off by `_residual` (3,) [m], which is in no command.
        """
        model, ghost, arm = self._arm.model, self._ghost, self._arm
        ghost.qpos[:], joints = arm.data.qpos, arm.position_addresses
        dofs, jacobian, error = arm.dofs, np.zeros((6, model.nv)), np.zeros(6)
        inverse, turn = np.zeros(4), np.zeros(4)
        for _ in range(IK_STEPS):
            mujoco.mj_kinematics(model, ghost)
            mujoco.mj_comPos(model, ghost)
            mujoco.mj_jacBody(model, ghost, jacobian[:3], jacobian[3:], self._tool)
            error[:3] = self._position - ghost.xpos[self._tool]
            mujoco.mju_negQuat(inverse, ghost.xquat[self._tool])
            mujoco.mju_mulQuat(turn, self._rotation, inverse)
            mujoco.mju_quat2Vel(error[3:], turn, 1.0)
            J = jacobian[:, dofs]
            ghost.qpos[joints] += J.T @ np.linalg.solve(J @ J.T + IK_DAMPING**2 * np.eye(6), error)
        mujoco.mj_kinematics(model, ghost)
        self._residual = ghost.xpos[self._tool] - self._position
        return ghost.qpos[joints].copy()

    def _ghost_distances(self) -> tuple[float, float]:
        """Upper bounds [m] of the distance of a point of hand and arm as computed, where the ghost is, and measured."""
        hand, arm = (self._ghost_distance(geoms) for geoms in self._geoms)
        return hand, arm

    def _ghost_distance(self, geoms: Sequence[int]) -> float:
        model, data, ghost = self._arm.model, self._arm.data, self._ghost
        moved = np.linalg.norm(data.geom_xpos[geoms] - ghost.geom_xpos[geoms], axis=1)
        chord = np.linalg.norm(data.geom_xmat[geoms] - ghost.geom_xmat[geoms], axis=1) / np.sqrt(2.0)
        return float(np.max(moved + chord * model.geom_rbound[geoms], initial=0.0))


def _hand_and_arm(robot_model: RobotModel) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The links that move with the last joint, and the other ones."""
    n = robot_model.n
    hand = tuple(link.name for link in robot_model.links if link.frame == n)
    return hand, tuple(link.name for link in robot_model.links if link.frame < n)


def _geoms_of_hand_and_arm(arm: MujocoArm) -> tuple[list[int], list[int]]:
    """The geoms that move with the last joint, and the other ones of the arm."""
    hand = arm.bodies_from(-1)
    geoms = [g for g in range(arm.model.ngeom) if int(arm.model.geom_bodyid[g]) in arm.bodies]
    return (
        [g for g in geoms if int(arm.model.geom_bodyid[g]) in hand],
        [g for g in geoms if int(arm.model.geom_bodyid[g]) not in hand],
    )


def _without_joint_limits(robot_model: RobotModel) -> RobotModel:
    """`robot_model` with a range of each joint that no posture leaves."""
    joints = tuple(
        msgspec.structs.replace(
            joint,
            lower=msgspec.structs.replace(joint.lower, value=joint.lower.value - WIDER),
            upper=msgspec.structs.replace(joint.upper, value=joint.upper.value + WIDER),
        )
        for joint in robot_model.joints
    )
    return msgspec.structs.replace(robot_model, joints=joints)
