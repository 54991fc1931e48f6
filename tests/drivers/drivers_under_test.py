"""Fresh subjects for the laws: the simulated arms and the fakes of two makers' interfaces."""

from functools import partial

from dualbrain.control.gatekeeper.robot_link.simulated_driver import SimulatedDriver
from dualbrain.drivers.conformance.harness import DriverUnderTest
from dualbrain.drivers.fakes.franka import FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import FrankaDriver
from dualbrain.drivers.ur import UrDriver
from dualbrain.robots.loader import load_robot


def franka(body=None):
    body = body or load_robot("fr3")
    sdk = FakeFranka(body)
    return DriverUnderTest(
        FrankaDriver(sdk, "fake", body), body, sdk.controller.press_user_stop, sdk.controller.release_user_stop
    )


def ur():
    body = load_robot("ur5e")
    sdk = FakeUr(body)

    def clear():
        while sdk.controller.protective_stopped:
            sdk.controller.step()
            sdk.controller.unlock_protective_stop()

    return DriverUnderTest(UrDriver(sdk, "fake", body), body, sdk.controller.trigger_protective_stop, clear)


def plant(robot):
    body = load_robot(robot)
    return DriverUnderTest(SimulatedDriver(body), body)


DRIVERS_UNDER_TEST = {
    "franka": franka,
    "ur": ur,
    "panda plant": partial(plant, "panda"),
    "ur5e plant": partial(plant, "ur5e"),
}
