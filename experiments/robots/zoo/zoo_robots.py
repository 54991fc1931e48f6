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


@dataclass(frozen=True, slots=True, kw_only=True)
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
    return ZooRobot(name=name, file=f"ur_description/urdf/{name}.urdf")


ROBOTS = (
    ZooRobot(name="panda", file="panda_description/urdf/panda.urdf"),
    ZooRobot(name="panda_collision", file="panda_description/urdf/panda_collision.urdf"),
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
    ZooRobot(name="xarm7", file="xarm_description/urdf/xarm7.urdf"),
    ZooRobot(name="kinova", file="kinova_description/robots/kinova.urdf"),
    ZooRobot(name="z1", file="z1_description/urdf/z1.urdf"),
    ZooRobot(name="so100", file="so_arm_description/urdf/so100.urdf"),
    ZooRobot(name="so101", file="so_arm_description/urdf/so101.urdf"),
    ZooRobot(name="talos_left_arm", file="talos_data/robots/talos_left_arm.urdf", tip="arm_left_7_link"),
    ZooRobot(name="asr_twodof", file="asr_twodof_description/urdf/TwoDofs.urdf"),
    ZooRobot(
        name="double_pendulum",
        file="double_pendulum_description/urdf/double_pendulum.urdf",
        velocity=5.0,
        joints={"joint1": (-3.0, 3.0), "joint2": (-3.0, 3.0)},
    ),
    ZooRobot(
        name="double_pendulum_simple",
        file="double_pendulum_description/urdf/double_pendulum_simple.urdf",
        velocity=5.0,
        joints={"joint1": (-3.0, 3.0), "joint2": (-3.0, 3.0)},
    ),
    ZooRobot(
        name="double_pendulum_continuous",
        file="double_pendulum_description/urdf/double_pendulum_continuous.urdf",
        velocity=5.0,
    ),
    ZooRobot(name="baxter_left", file="baxter_description/urdf/baxter.urdf", tip="left_wrist"),
    ZooRobot(name="baxter_right", file="baxter_description/urdf/baxter.urdf", tip="right_wrist"),
    ZooRobot(name="tiago", file="tiago_description/robots/tiago.urdf", tip="arm_tool_link"),
    ZooRobot(name="tiago_no_hand", file="tiago_description/robots/tiago_no_hand.urdf"),
    ZooRobot(name="tiago_dual_left", file="tiago_description/robots/tiago_dual.urdf", tip="arm_left_tool_link"),
    ZooRobot(name="tiago_dual_right", file="tiago_description/robots/tiago_dual.urdf", tip="arm_right_tool_link"),
    ZooRobot(name="tiago_pro_left", file="tiago_pro_description/robots/tiago_pro.urdf", tip="arm_left_7_link"),
    ZooRobot(name="tiago_pro_right", file="tiago_pro_description/robots/tiago_pro.urdf", tip="arm_right_7_link"),
    ZooRobot(name="pr2_left", file="pr2_description/urdf/pr2.urdf", tip="l_wrist_roll_link"),
    ZooRobot(name="pr2_right", file="pr2_description/urdf/pr2.urdf", tip="r_wrist_roll_link"),
    ZooRobot(
        name="tiago_base",
        file="tiago_description/robots/tiago_no_hand.urdf",
        mobile=True,
        wheels=("wheel_left_joint", "wheel_right_joint"),
    ),
    ZooRobot(name="tiago_pro_base", file="tiago_pro_description/robots/tiago_pro.urdf", mobile=True),
    ZooRobot(name="pr2_base", file="pr2_description/urdf/pr2.urdf", mobile=True),
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
    whole = {"period": 0.02 if robot.mobile else 0.002, "tool_speed": 0.5}
    if robot.mobile:
        whole["turn_acceleration"] = 2.0
    if robot.mobile and robot.wheels is None:
        whole["turn"] = 1.0
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
