"""Fresh subjects for the laws: the simulated arms and the fakes of two makers' interfaces."""

from functools import partial

from dualbrain.control.gatekeeper.robot_link.simulated_driver import PlantDriver
from dualbrain.drivers.conformance.harness import Subject
from dualbrain.drivers.fakes.franka import FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import FrankaDriver
from dualbrain.drivers.ur import UrDriver
from dualbrain.robots.loader import load_body


def franka(body=None):
    body = body or load_body("fr3")
    sdk = FakeFranka(body)
    return Subject(FrankaDriver(sdk, "fake", body), body, sdk.controller.press, sdk.controller.release)


def ur():
    body = load_body("ur5e")
    sdk = FakeUr(body)

    def clear():
        while sdk.controller.stopped:
            sdk.controller.step()
            sdk.controller.unlock()

    return Subject(UrDriver(sdk, "fake", body), body, sdk.controller.protect, clear)


def plant(robot):
    body = load_body(robot)
    return Subject(PlantDriver(body), body)


SUBJECTS = {"franka": franka, "ur": ur, "panda plant": partial(plant, "panda"), "ur5e plant": partial(plant, "ur5e")}
