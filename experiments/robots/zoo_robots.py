"""Foreign robots: every serial arm and mobile base of `example-robot-data` 6.0.0, by its file.

`EXCLUDED` lists the robots of its 38 folders that a `RobotModel` cannot describe, with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from dualbrain.robots.importer.required_limits import LimitPolicy, StatedLimit

PACKAGE = "example-robot-data"


@dataclass(frozen=True, slots=True)
class ZooRobot:
    """One robot of the zoo: its `file` in the package's robots/, and values that its description lacks."""

    name: str
    file: str
    tip: str = ""
    base: str = ""
    lock: dict[str, float] = field(default_factory=dict)
    wheels: tuple[str, str] | None = None
    mobile: bool = False
    velocity: float | None = None
    joints: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Ranges of joints for which the description has none."""


def _ur_robot(name: str) -> ZooRobot:
    return ZooRobot(name, f"ur_description/urdf/{name}.urdf")


ROBOTS = (
    ZooRobot("panda", "panda_description/urdf/panda.urdf"),
    ZooRobot("panda_collision", "panda_description/urdf/panda_collision.urdf"),
    *map(
        _ur_robot,
        (
            "ur3_robot",
            "ur3_gripper",
            "ur3_joint_limited_robot",
            "ur5_robot",
            "ur5_gripper",
            "ur5_joint_limited_robot",
            "ur10_robot",
            "ur10_joint_limited_robot",
        ),
    ),
    ZooRobot("xarm7", "xarm_description/urdf/xarm7.urdf"),
    ZooRobot("kinova", "kinova_description/robots/kinova.urdf"),
    ZooRobot("z1", "z1_description/urdf/z1.urdf"),
    ZooRobot("so100", "so_arm_description/urdf/so100.urdf"),
    ZooRobot("so101", "so_arm_description/urdf/so101.urdf"),
    ZooRobot("talos_left_arm", "talos_data/robots/talos_left_arm.urdf", tip="arm_left_7_link"),
    ZooRobot("asr_twodof", "asr_twodof_description/urdf/TwoDofs.urdf"),
    ZooRobot(
        "double_pendulum",
        "double_pendulum_description/urdf/double_pendulum.urdf",
        velocity=5.0,
        joints={"joint1": (-3.0, 3.0), "joint2": (-3.0, 3.0)},
    ),
    ZooRobot(
        "double_pendulum_simple",
        "double_pendulum_description/urdf/double_pendulum_simple.urdf",
        velocity=5.0,
        joints={"joint1": (-3.0, 3.0), "joint2": (-3.0, 3.0)},
    ),
    ZooRobot(
        "double_pendulum_continuous", "double_pendulum_description/urdf/double_pendulum_continuous.urdf", velocity=5.0
    ),
    ZooRobot("baxter_left", "baxter_description/urdf/baxter.urdf", tip="left_wrist"),
    ZooRobot("baxter_right", "baxter_description/urdf/baxter.urdf", tip="right_wrist"),
    ZooRobot("tiago", "tiago_description/robots/tiago.urdf", tip="arm_tool_link"),
    ZooRobot("tiago_no_hand", "tiago_description/robots/tiago_no_hand.urdf"),
    ZooRobot("tiago_dual_left", "tiago_description/robots/tiago_dual.urdf", tip="arm_left_tool_link"),
    ZooRobot("tiago_dual_right", "tiago_description/robots/tiago_dual.urdf", tip="arm_right_tool_link"),
    ZooRobot("tiago_pro_left", "tiago_pro_description/robots/tiago_pro.urdf", tip="arm_left_7_link"),
    ZooRobot("tiago_pro_right", "tiago_pro_description/robots/tiago_pro.urdf", tip="arm_right_7_link"),
    ZooRobot("pr2_left", "pr2_description/urdf/pr2.urdf", tip="l_wrist_roll_link"),
    ZooRobot("pr2_right", "pr2_description/urdf/pr2.urdf", tip="r_wrist_roll_link"),
    ZooRobot(
        "tiago_base",
        "tiago_description/robots/tiago_no_hand.urdf",
        mobile=True,
        wheels=("wheel_left_joint", "wheel_right_joint"),
    ),
    ZooRobot("tiago_pro_base", "tiago_pro_description/robots/tiago_pro.urdf", mobile=True),
    ZooRobot("pr2_base", "pr2_description/urdf/pr2.urdf", mobile=True),
)
"""The robots of the zoo; walking and aerial robots and hands are out of scope."""

EXCLUDED = {
    "legs": (
        "a1",
        "alexander",
        "anymal_b_simple",
        "anymal_c_simple",
        "b1",
        "bolt",
        "cassie",
        "g1",
        "go1",
        "go2",
        "hyq",
        "icub",
        "laikago",
        "quadruped",
        "romeo",
        "simple_humanoid",
        "solo",
        "human",
        "alex",
    ),
    "legs with wheels and two arms": ("centauro",),
    "aerial robots": ("borinot", "hector", "hextilt", "iris"),
    "a hand or finger": ("allegro_hand", "finger_edu"),
}
EMPTY_FILES = {"ur_description/urdf/ur3.urdf": "an empty xacro stub without a robot in it"}


def stated_limits(robot: ZooRobot) -> LimitPolicy:
    """The limits that a user would state: the same for all robots, and those that a description lacks."""
    source = "zoo: stated for the experiment"
    every = {"acceleration": StatedLimit(1.0 if robot.mobile else 10.0, source)}
    if robot.velocity is not None:
        every["velocity"] = StatedLimit(robot.velocity, source)
    joints = {
        name: {"lower": StatedLimit(low, source), "upper": StatedLimit(high, source)}
        for name, (low, high) in robot.joints.items()
    }
    whole = {"period": 0.02 if robot.mobile else 0.002, "tool_speed": 0.5, "turn": 1.0, "turn_acceleration": 2.0}
    if robot.wheels is not None:
        del whole["turn"]
    return LimitPolicy(every, joints, {side: StatedLimit(value, source) for side, value in whole.items()})


def robots_folder() -> Path:
    """The folder robots/ of the installed package."""
    for file in metadata.files(PACKAGE) or []:
        parts = file.parts
        if "robots" in parts[:-1] and parts[parts.index("robots") - 1] == PACKAGE:
            whole = Path(str(file.locate()))
            return whole.parents[len(parts) - parts.index("robots") - 2]
    raise FileNotFoundError(PACKAGE)


def import_pinocchio() -> Any:
    """The module pinocchio; its wheel installs into a folder that is not on every interpreter's path."""
    try:
        import pinocchio as pin  # noqa: PLC0415
    except ModuleNotFoundError:
        import sys  # noqa: PLC0415

        inner = Path(str(metadata.distribution("pin").locate_file(""))) / "cmeel.prefix/lib"
        sys.path += [str(path) for path in inner.glob("python3.*/site-packages")]
        import pinocchio as pin  # noqa: PLC0415
    return pin
