"""Every law on every driver; and drivers that break one law each, which the suite must find."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.drivers.conformance.rules import REQUIREMENTS, RequirementStatus, check_conformance
from tests.drivers.drivers_under_test import DRIVERS_UNDER_TEST, franka


@pytest.mark.parametrize("name", DRIVERS_UNDER_TEST)
def test_every_law_is_kept(name):
    findings = check_conformance(DRIVERS_UNDER_TEST[name])
    assert [finding for finding in findings if finding.status is RequirementStatus.VIOLATED] == []
    kept = {finding.requirement for finding in findings if finding.status is RequirementStatus.MET}
    left = {law.name for law in REQUIREMENTS} - kept
    assert left <= ({"silence", "maker's stop"} if "plant" in name else set())


class Bent:
    """A driver in front of another, which a test bends."""

    def __init__(self, driver):
        self._driver = driver

    def __getattr__(self, name):
        return getattr(self._driver, name)


class Swapped(Bent):
    def write(self, command):
        self._driver.write(replace(command, u=command.u[[1, 0, *range(2, len(command.u))]]))


class Clipped(Bent):
    def write(self, command):
        self._driver.write(replace(command, u=np.clip(command.u, -0.4, 0.4)))


class Counting(Bent):
    """Gives a new sequence number with each reading."""

    count = 0

    def read(self):
        self.count += 1
        return replace(self._driver.read(), sequence=self.count)


class Aliased(Bent):
    """Hands out the same array each time."""

    def __init__(self, driver):
        super().__init__(driver)
        self._q = driver.read().q.copy()

    def read(self):
        state = self._driver.read()
        self._q[:] = state.q
        return replace(state, q=self._q)


class Eager(Bent):
    """Switches the drive on when it is written to."""

    def write(self, command):
        self._driver.enable()
        self._driver.write(command)


class Mute(Bent):
    def faults(self):
        return ()


class Hiding(Bent):
    """Says that the drive is on, whatever it is."""

    def read(self):
        return replace(self._driver.read(), drive_enabled=True)


class Remembering(Bent):
    """Goes on with the last command as soon as the drive is on again."""

    last = None

    def write(self, command):
        if self.last is not None and not command.u.any() and self._driver.read().drive_enabled:
            command = self.last
        elif command.u.any():
            self.last = replace(command, u=0.02 * np.sign(command.u))
        self._driver.write(command)


class Untiring(Bent):
    """Repeats the last command from inside, so that the arm's own watchdog never bites."""

    last = None

    def write(self, command):
        self.last = command
        self._driver.write(command)

    def wait(self):
        if self.last is not None:
            self._driver.write(self.last)
        self._driver.wait()


class Trusting(Bent):
    """Puts the last good command in the place of what is not finite."""

    last = None

    def write(self, command):
        self.last = command if np.isfinite(command.u).all() else self.last
        self._driver.write(self.last)


class Raising(Bent):
    def wait(self):
        self._driver.wait()
        if self._driver.faults():
            raise RuntimeError(self._driver.faults()[0])


@pytest.mark.parametrize(
    ("bent", "law"),
    [
        (Swapped, "right joint"),
        (Clipped, "as hard as the body may"),
        (Counting, "reading is free"),
        (Aliased, "handed out"),
        (Eager, "waits for enable"),
        (Mute, "maker's stop"),
        (Hiding, "stops"),
        (Remembering, "forgets"),
        (Untiring, "silence"),
        (Trusting, "rubbish"),
        (Raising, "maker's stop"),
        (Hiding, "closes"),
    ],
)
def test_a_driver_that_breaks_a_law_is_found(bent, law):
    def make():
        subject = franka()
        return replace(subject, driver=bent(subject.driver))

    (finding,) = check_conformance(make, tuple(one for one in REQUIREMENTS if one.name == law))
    assert finding.status is RequirementStatus.VIOLATED, finding


def test_a_law_that_nothing_can_provoke_is_not_called_kept():
    (finding,) = check_conformance(
        lambda: replace(franka(), trigger_stop=None), tuple(one for one in REQUIREMENTS if one.name == "maker's stop")
    )
    assert finding.status is RequirementStatus.NOT_TESTED
