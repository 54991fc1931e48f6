"""The simulated arm behind the driver contract: the oracle of the conformance laws, at no period's mercy."""

from __future__ import annotations

from dataclasses import replace
from math import inf

from dualbrain.drivers.driver import is_finite
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import Timing, simulated_timing
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene


class SimulatedDriver:
    """A plant in a bare scene. Nobody watches it: without commands it goes on (the robot process has the watchdog)."""

    watchdog: float = inf

    def __init__(self, robot_model: RobotModel) -> None:
        """The arm at home, drive off."""
        self._plant = make_plant(open_scene("bare:0", robot_model.name), robot_model)
        self.timing: Timing = simulated_timing(robot_model.period)
        self._faults: tuple[str, ...] = ()
        self._plant.stop()
        self._state = self._plant.read()

    def read(self) -> RobotState:
        """The state at the end of the last period."""
        return self._state

    def write(self, command: Command) -> None:
        """Hold `command` until the next one."""
        if not self._state.drive_enabled:
            return
        if is_finite(command):
            self._plant.write(command)
        else:
            self.stop()
            self._faults = ("a command that is not finite",)

    def stop(self) -> None:
        """Brakes on."""
        self._plant.stop()
        self._state = replace(self._state, drive_enabled=False)

    def enable(self) -> None:
        """Brakes off, standing."""
        self._faults = ()
        self._plant.enable()
        self._state = replace(self._state, drive_enabled=True)

    def wait(self) -> None:
        """One control period of physics."""
        self._plant.advance()
        self._state = self._plant.read()

    def faults(self) -> tuple[str, ...]:
        """What was refused."""
        return self._faults

    def close(self) -> None:
        """Brakes on."""
        self.stop()
