"""New drivers for the conformance test: the simulated arms, and the fakes of two vendors' libraries."""

from functools import partial

from dualbrain.control.gatekeeper.robot_link.simulated_driver import SimulatedDriver
from dualbrain.drivers.conformance.harness import DriverUnderTest
from dualbrain.drivers.fakes.franka import FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import FrankaDriver
from dualbrain.drivers.ur import UrDriver
from dualbrain.robots.loader import load_robot


def franka(robot_model=None):
    robot_model = robot_model or load_robot("fr3")
    sdk = FakeFranka(robot_model)
    return DriverUnderTest(
        FrankaDriver(sdk, "fake", robot_model),
        robot_model,
        sdk.controller.press_user_stop,
        sdk.controller.release_user_stop,
    )


def ur():
    robot_model = load_robot("ur5e")
    sdk = FakeUr(robot_model)

    def clear():
        while sdk.controller.protective_stopped:
            sdk.controller.step()
            sdk.controller.unlock_protective_stop()

    return DriverUnderTest(
        UrDriver(sdk, "fake", robot_model), robot_model, sdk.controller.trigger_protective_stop, clear
    )


def plant(robot):
    robot_model = load_robot(robot)
    return DriverUnderTest(SimulatedDriver(robot_model), robot_model)


DRIVERS_UNDER_TEST = {
    "franka": franka,
    "ur": ur,
    "panda plant": partial(plant, "panda"),
    "ur5e plant": partial(plant, "ur5e"),
}
