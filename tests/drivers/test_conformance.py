"""Every driver meets all requirements, and the conformance test finds drivers that violate one requirement each."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.cli.main import run_command_line
from dualbrain.control.gatekeeper.robot_link.simulated_driver import SimulatedDriver
from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.drivers.conformance import rules
from dualbrain.drivers.conformance.harness import DriverUnderTest
from dualbrain.drivers.conformance.home_posture import find_home_problem
from dualbrain.drivers.conformance.rules import (
    REQUIREMENTS,
    RequirementStatus,
    check_conformance,
    make_requirements,
)
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.safety.cbf.obstacles import Obstacle
from tests.drivers.drivers_under_test import DRIVERS_UNDER_TEST, franka

PANDA = load_robot("panda")


@pytest.mark.parametrize("name", DRIVERS_UNDER_TEST)
def test_every_requirement_is_met(name):
    results = check_conformance(DRIVERS_UNDER_TEST[name])
    assert [result for result in results if result.status is RequirementStatus.VIOLATED] == []
    met = {result.requirement for result in results if result.status is RequirementStatus.MET}
    not_tested = {requirement.name for requirement in REQUIREMENTS} - met
    assert not_tested <= ({"silence", "maker's stop"} if "plant" in name else set())


FOLDED = (*PANDA.home[:5], 0.0, PANDA.home[6])
"""A posture of the Panda with its hand in its forearm."""


@pytest.mark.parametrize(
    ("home", "obstacles", "problem"),
    [
        (PANDA.home, (), ""),
        (PANDA.home, (Obstacle("table", HalfSpace()),), ""),
        (PANDA.home, (Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.6)), parts=("hand",)),), "vs 'table'"),
        ((3.0, *PANDA.home[1:]), (), "panda_joint1 has the home position 3.000"),
        ((*PANDA.home[:6], float("nan")), (), "panda_joint7 has the home position nan"),
        (FOLDED, (), "link7 vs link5"),
    ],
)
def test_a_home_posture_that_is_not_free_is_found(home, obstacles, problem):
    def make():
        return DriverUnderTest(SimulatedDriver(PANDA), msgspec.structs.replace(PANDA, home=home))

    (result,) = check_conformance(make, tuple(one for one in make_requirements(obstacles) if one.name == "home"))
    assert result.status is (RequirementStatus.VIOLATED if problem else RequirementStatus.MET)
    assert problem in result.reason


@pytest.mark.parametrize("name", BUILTIN_ROBOTS)
def test_the_home_posture_of_every_packaged_robot_is_free(name):
    assert find_home_problem(load_robot(name)) == ""


@pytest.mark.parametrize(("height", "code"), [(0.0, 0), (0.6, 1)])
def test_the_command_compares_the_home_posture_with_the_site(tmp_path, monkeypatch, capsys, height, code):
    site = tmp_path / "site.toml"
    site.write_text(f'[[plane]]\nname = "top"\npoint = [0, 0, {height}]\ninward = [0, 0, 1]\nparts = ["hand"]\n')

    def check_home(make, requirements):
        return check_conformance(make, tuple(one for one in requirements if one.name == "home"))

    monkeypatch.setattr(rules, "check_conformance", check_home)
    assert run_command_line(["robot", "conform", "--driver", "fake_franka", "--site", str(site)]) == code
    assert ("vs 'top'" in capsys.readouterr().err) is bool(code)


class FaultyDriver:
    """A driver that passes all calls on to another; subclasses introduce one fault each."""

    def __init__(self, driver):
        self._driver = driver

    def __getattr__(self, name):
        return getattr(self._driver, name)


class SwapsJoints(FaultyDriver):
    def write(self, command):
        self._driver.write(replace(command, u=command.u[[1, 0, *range(2, len(command.u))]]))


class ClipsCommands(FaultyDriver):
    def write(self, command):
        self._driver.write(replace(command, u=np.clip(command.u, -0.4, 0.4)))


class LagsBehind(FaultyDriver):
    """Commands the mean of the last 50 ms: the joints arrive, but late."""

    def __init__(self, driver):
        super().__init__(driver)
        self._last = []

    def write(self, command):
        self._last = [*self._last[-49:], command.u]
        self._driver.write(replace(command, u=np.mean(self._last, axis=0)))


class CountsReads(FaultyDriver):
    """Returns a new sequence number with each call of read."""

    count = 0

    def read(self):
        self.count += 1
        return replace(self._driver.read(), sequence=self.count)


class ReusesArrays(FaultyDriver):
    """Returns the same array each time."""

    def __init__(self, driver):
        super().__init__(driver)
        self._q = driver.read().q.copy()

    def read(self):
        state = self._driver.read()
        self._q[:] = state.q
        return replace(state, q=self._q)


class EnablesOnWrite(FaultyDriver):
    """Enables the drive with each command."""

    def write(self, command):
        self._driver.enable()
        self._driver.write(command)


class ReportsNoFaults(FaultyDriver):
    def faults(self):
        return ()


class AlwaysReportsEnabled(FaultyDriver):
    """Reports that the drive is on, also when it is off."""

    def read(self):
        return replace(self._driver.read(), drive_enabled=True)


class RepeatsOldCommand(FaultyDriver):
    """Repeats the last command as soon as the drive is on again."""

    last = None

    def write(self, command):
        if self.last is not None and not command.u.any() and self._driver.read().drive_enabled:
            command = self.last
        elif command.u.any():
            self.last = replace(command, u=0.02 * np.sign(command.u))
        self._driver.write(command)


class DefeatsWatchdog(FaultyDriver):
    """Repeats the last command while it waits, so that the watchdog of the arm never stops it."""

    last = None

    def write(self, command):
        self.last = command
        self._driver.write(command)

    def wait(self):
        if self.last is not None:
            self._driver.write(self.last)
        self._driver.wait()


class ReplacesNonFinite(FaultyDriver):
    """Replaces a command that is not finite by the last finite one."""

    last = None

    def write(self, command):
        self.last = command if np.isfinite(command.u).all() else self.last
        self._driver.write(self.last)


class Raises(FaultyDriver):
    def wait(self):
        self._driver.wait()
        if self._driver.faults():
            raise RuntimeError(self._driver.faults()[0])


def requirement(name):
    return tuple(one for one in REQUIREMENTS if one.name == name)


@pytest.mark.parametrize(
    ("faulty", "name"),
    [
        (SwapsJoints, "right joint"),
        (ClipsCommands, "as hard as the body may"),
        (LagsBehind, "follows"),
        (CountsReads, "reading is free"),
        (ReusesArrays, "handed out"),
        (EnablesOnWrite, "waits for enable"),
        (ReportsNoFaults, "maker's stop"),
        (AlwaysReportsEnabled, "stops"),
        (RepeatsOldCommand, "forgets"),
        (DefeatsWatchdog, "silence"),
        (ReplacesNonFinite, "rubbish"),
        (Raises, "maker's stop"),
        (AlwaysReportsEnabled, "closes"),
    ],
)
def test_a_faulty_driver_violates_the_requirement(faulty, name):
    def make_driver():
        under_test = franka()
        return replace(under_test, driver=faulty(under_test.driver))

    (result,) = check_conformance(make_driver, requirement(name))
    assert result.status is RequirementStatus.VIOLATED, result


def test_a_drive_that_is_late_still_arrives_so_that_only_one_requirement_notices_it():
    def make_driver():
        under_test = franka()
        return replace(under_test, driver=LagsBehind(under_test.driver))

    (late,) = check_conformance(make_driver, requirement("follows"))
    (joint,) = check_conformance(make_driver, requirement("right joint"))
    assert "from the integral of its commands; the robot model declares 0.00" in late.reason
    assert joint.status is RequirementStatus.MET


def test_a_requirement_that_cannot_be_tested_does_not_count_as_met():
    (result,) = check_conformance(lambda: replace(franka(), trigger_stop=None), requirement("maker's stop"))
    assert result.status is RequirementStatus.NOT_TESTED
