"""The announcement of this connector for `dualbrain doctor`."""

from importlib.metadata import version

from lerobot.processor import ProcessorStepRegistry
from lerobot.robots import RobotConfig

from dualbrain import Connector

ROBOT, STEP = "dualbrain_guarded", "dualbrain_safety_filter"


def check() -> list[str]:
    """The problems of this installation."""
    problems: list[str] = []
    if ROBOT not in RobotConfig.get_known_choices():
        problems.append(f"LeRobot does not know the robot {ROBOT}. Install the connector again.")
    try:
        ProcessorStepRegistry.get(STEP)
    except KeyError:
        problems.append(f"LeRobot does not know the processor step {STEP}. Install the connector again.")
    return problems


def connector() -> Connector:
    """The connector of LeRobot."""
    return Connector(
        name="LeRobot",
        description=f"robot {ROBOT} that guards any other robot, and processor step {STEP}",
        version=version("lerobot_robot_dualbrain"),
        framework="lerobot",
        framework_version="0.6.1",
        check=check,
    )
