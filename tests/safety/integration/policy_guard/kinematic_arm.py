"""A Panda whose joints follow the command of a guard exactly, in any action space, between three obstacles."""

from dataclasses import replace

import numpy as np

from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout
from dualbrain.safety.integration.policy_guard.action_space import GuardedArm
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition, JointVelocity
from dualbrain.safety.integration.policy_guard.tool_actions import ToolPose, ToolTwist
from tests.safety.integration.gym_environments import DERATED_PANDA, EXACT_CONFIG, OBSTACLES, PERIOD, V_MAX

HOME = np.array(DERATED_PANDA.home)
GRIPPER = 0.04
"""Last entry of every action [m]; it must pass unchanged."""
KINEMATICS = SafetyFilter(DERATED_PANDA)
SPACES = {
    "joint velocity": JointVelocity(),
    "joint position": JointPosition(),
    "joint delta": JointPosition(delta=True),
    "joint delta to measured": JointPosition(delta=True, reference="measured"),
    "tool twist": ToolTwist(),
    "tool velocity": ToolTwist(angular=False),
    "tool twist in tool axes": ToolTwist(frame="tool"),
    "tool pose": ToolPose(),
    "tool pose with quaternion": ToolPose(rotation="quaternion"),
    "tool position": ToolPose(rotation="none"),
    "tool delta": ToolPose(delta=True),
    "tool delta in tool axes": ToolPose(delta=True, frame="tool"),
}


def make_guard(space, steps=4, obstacles=OBSTACLES, **more):
    """A guard of the space with the name `space`, with `steps` periods of the filter per action."""
    safety = SafetyFilter(DERATED_PANDA, EXACT_CONFIG, obstacles=obstacles)
    chosen = SPACES[space] if isinstance(space, str) else space
    return PolicyGuard(safety, chosen, period=steps * PERIOD, **more)


def random_action(space, rng, q, speed=1.0, steps=4):
    """An action (with a gripper entry) that moves the arm from `q` at about `speed` times full speed."""
    time, chosen = steps * PERIOD, SPACES[space]
    tool, u = KINEMATICS.tool(q), speed * V_MAX * rng.choice([-1.0, 1.0], 7)
    arm = GuardedArm(
        safety=KINEMATICS, velocity_limits=V_MAX, q=q, v=np.zeros(7), start=q, target=q + time * u, elapsed=time
    )
    if isinstance(chosen, JointVelocity):
        values = u
    elif isinstance(chosen, JointPosition):
        values = time * u if chosen.delta else q + time * u
    elif isinstance(chosen, ToolPose):
        values = chosen.values(arm.tool(), tool)
    else:
        axes = tool.rotation if chosen.frame == "tool" else np.eye(3)
        twist = tool.jacobian @ u
        values = np.concatenate([axes.T @ twist[:3], axes.T @ twist[3:]])[: chosen.count(7)]
    return np.append(values, GRIPPER)


def scaled(space, scale, offset):
    """`space` with actions in other units."""
    return replace(space, layout=ActionLayout(scale=scale, offset=offset))
