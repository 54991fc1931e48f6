"""gym-aloha: two ViperX 300 S arms with joint positions as actions, one filter each."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import mujoco

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.integration.policy_guard.guard import Deviation
from dualbrain.simulation.environments.guarded_arms import ArmPlace, GuardedArms

SIDES = ("left", "right")
TABLE = "table/table"
"""Body and geom of the table."""
HAND_GROUPS, ARM_PARTS = ("hand", "fingers"), ("arm",)
"""Groups of links of the robot model that are the hand of an arm, and the other ones that move."""
TOUCHABLE = ("table", "hand")
ENTRIES_PER_ARM = 7
"""Six joint positions and the opening of the gripper."""


def guard_aloha(
    env: Any,
    *,
    may_touch: Collection[str] = (),
    margin: float = 0.0,
    robot_model: RobotModel | None = None,
    config: FilterConfig | None = None,
    deviation: Deviation = "nearest",
) -> GuardedArms:
    """`env`, which is reset once, with the joint positions of both arms replaced by the closest safe ones.

    Two lines for `gymnasium.make("gym_aloha/AlohaTransferCube-v0")` or `AlohaInsertion-v0`:

        from dualbrain.simulation.environments import guard_aloha
        env = guard_aloha(gymnasium.make("gym_aloha/AlohaTransferCube-v0"), may_touch=("table", "hand"))

    Each arm has a filter of its own and keeps away from the table and from the other arm. Both arms move, so each has
    half of the responsibility for their distance: it treats the other arm as an obstacle at rest, with half of the
    gain (`arm_spheres`), and may come to rest at any time. The entries of the grippers pass unchanged; a gripper counts
    as open at any width. Objects that move freely (cube, peg, socket) are no obstacles.

    The margins for the tracking error of the servos keep a hand several centimetres away from the table and from the
    other arm. A task that picks up and hands over therefore needs `may_touch`: with "table" the hands (gripper and
    fingers) do not keep away from the table, with "hand" they do not keep away from each other. Those contacts are then
    not guarded at all, not even their speed.
    All other parts keep away. `margin` [m] enlarges the table. `robot_model` is by default `load_robot("vx300s")`,
    whose tracking error was identified on the servos of gym-aloha.

    Raises:
        ConfigurationError: the environment is not that of gym-aloha, `may_touch` has another word, or a `ClipAction`
            or the servos clip joint positions to less than the joint limits of `robot_model`.
        UnknownNameError: its MuJoCo model has no joint or body of a name.
    """
    if isinstance(may_touch, str) or not set(may_touch) <= set(TOUCHABLE):
        raise ConfigurationError("may_touch", got=may_touch, allowed=f"a tuple with words among {', '.join(TOUCHABLE)}")
    model = load_robot("vx300s") if robot_model is None else robot_model
    return GuardedArms(
        env,
        model,
        tuple(_place(side, index, model) for index, side in enumerate(SIDES)),
        ignored=_free_bodies,
        obstacle_parts={TABLE: ARM_PARTS} if "table" in may_touch else {},
        arm_parts=dict.fromkeys(HAND_GROUPS, ARM_PARTS) if "hand" in may_touch else {},
        margin=margin,
        config=config,
        deviation=deviation,
        clips=False,  # gym-aloha states ±1, and passes joint positions [rad] to the servos
    )


def _place(side: str, index: int, robot_model: RobotModel) -> ArmPlace:
    first = ENTRIES_PER_ARM * index
    return ArmPlace(
        name=side,
        joints=tuple(f"vx300s_{side}/{joint.name}" for joint in robot_model.joints),
        base=f"vx300s_{side}",
        entries=tuple(range(first, first + robot_model.n)),
    )


def _free_bodies(model: Any) -> set[str]:
    """The bodies that move freely: objects of the task."""
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    return {model.body(int(model.jnt_bodyid[j])).name for j in range(model.njnt) if int(model.jnt_type[j]) == free}
