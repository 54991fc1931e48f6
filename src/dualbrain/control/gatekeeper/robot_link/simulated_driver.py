"""The simulated arm behind the driver interface: the reference of the driver conformance tests, in lockstep."""

from __future__ import annotations

from dataclasses import replace
from math import inf

from dualbrain.drivers.driver import command_fault
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import Timing, simulated_timing
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene


class SimulatedDriver:
    """A plant in a bare scene. It has no watchdog and continues without commands; the robot process has one."""

    watchdog: float = inf

    def __init__(self, robot_model: RobotModel) -> None:
        """Put the arm at its home position, with the drive off."""
        self._plant = make_plant(open_scene("bare:0", robot_model.name), robot_model)
        self.timing: Timing = simulated_timing(robot_model.period)
        self._faults: tuple[str, ...] = ()
        self._plant.stop()
        self._state = self._plant.read()

    def read(self) -> RobotState:
        """The state at the end of the last period."""
        return self._state

    def write(self, command: Command) -> None:
        """Apply `command` until the next one."""
        if not self._state.drive_enabled:
            return
        if fault := command_fault(command, self._plant.robot_model.n):
            self.stop()
            self._faults = (fault,)
        else:
            self._plant.write(command)

    def stop(self) -> None:
        """Switch the drive off; the brakes engage."""
        self._plant.stop()
        self._state = replace(self._state, drive_enabled=False)

    def enable(self) -> None:
        """Switch the drive on, at rest."""
        self._faults = ()
        self._plant.enable()
        self._state = replace(self._state, drive_enabled=True)

    def wait(self) -> None:
        """Simulate one control period."""
        self._plant.advance()
        self._state = self._plant.read()

    def faults(self) -> tuple[str, ...]:
        """Faults since the drive was switched on."""
        return self._faults

    def close(self) -> None:
        """Switch the drive off."""
        self.stop()
