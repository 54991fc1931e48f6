"""The gatekeeper's end of the robot link: its clock."""

import math
from dataclasses import replace

import pytest

from dualbrain.control.gatekeeper.robot_link import packets, remote_robot
from dualbrain.control.gatekeeper.robot_link.remote_robot import RemoteRobot
from dualbrain.control.gatekeeper.timing.tick_timing import TickTimer
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.state_monitor import StateMonitor
from dualbrain.safety.supervisor.timing import SIMULATED


@pytest.fixture
def robot(monkeypatch):
    """A link without a process, at a time that a test sets."""
    made = object.__new__(RemoteRobot)
    made._state, made.tick_timer = None, TickTimer(SIMULATED)
    made._newest_stamp, made._arrived_at = remote_robot.NO_STAMP
    made.now = 50.0
    monkeypatch.setattr(remote_robot.time, "monotonic", lambda: made.now)
    return made


def receive(robot, stamp):
    robot._accept_state(packets.StatePacket.from_state(replace(home_state(load_robot("panda")), stamp=stamp)))


def test_the_clock_is_the_newest_stamp_and_the_time_since_its_arrival(robot):
    receive(robot, 7.0)
    robot.now += 0.25
    assert robot.clock() == pytest.approx(7.25)
    receive(robot, 7.2)
    assert robot.clock() == pytest.approx(7.2)


def test_a_robot_that_repeats_its_last_state_does_not_stop_the_clock(robot):
    receive(robot, 7.0)
    for _ in range(100):
        robot.now += 0.002
        receive(robot, 7.0)
    assert robot.clock() == pytest.approx(7.2)


@pytest.mark.parametrize("stamp", [math.nan, math.inf, -math.inf, 6.0], ids=str)
def test_a_stamp_that_is_not_finite_or_not_later_does_not_change_the_clock(robot, stamp):
    receive(robot, 7.0)
    for _ in range(100):
        robot.now += 0.002
        receive(robot, stamp)
    assert robot.clock() == pytest.approx(7.2)
    receive(robot, 7.3)
    assert robot.clock() == pytest.approx(7.3)


@pytest.mark.parametrize("stamp", [math.nan, math.inf], ids=str)
def test_a_robot_whose_stamps_are_not_finite_is_lost(robot, stamp):
    monitor = StateMonitor(load_robot("panda"))
    receive(robot, 7.0)
    monitor.check_state(robot.read(), robot.clock())
    for _ in range(100):
        robot.now += 0.002
        receive(robot, stamp)
        flags = monitor.check_state(robot.read(), robot.clock())
    assert flags & Condition.STATE_LOST


def test_before_the_first_finite_stamp_the_clock_runs(robot):
    receive(robot, math.nan)
    before = robot.clock()
    robot.now += 0.25
    assert robot.clock() == pytest.approx(before + 0.25)
    receive(robot, 7.0)
    assert robot.clock() == pytest.approx(7.0)
