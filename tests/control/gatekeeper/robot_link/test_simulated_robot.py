"""The watchdog of the simulated robot is fed by valid commands only."""

import socket
import time

import numpy as np
import pytest

from dualbrain.control.gatekeeper.robot_link import packets, simulated_robot
from dualbrain.control.gatekeeper.robot_link.simulated_robot import (
    WATCHDOG_TIMEOUT,
    RobotProcess,
    SimulatedRobotSettings,
)
from dualbrain.simulation.scenes.generators.catalogue import open_scene

N = 7
MOVING = packets.CommandPacket((0.1,) + (0.0,) * (N - 1), 0.04, 0.0)
BAD_NUMBERS = (float("nan"), float("inf"), float("-inf"))
INVALID = {
    **{f"speed {bad}": packets.CommandPacket((bad,) + (0.0,) * (N - 1), 0.04, 0.0) for bad in BAD_NUMBERS},
    **{f"opening {bad}": packets.CommandPacket((0.0,) * N, bad, 0.0) for bad in BAD_NUMBERS},
    **{f"force {bad}": packets.CommandPacket((0.0,) * N, 0.04, bad) for bad in BAD_NUMBERS},
    "no joints": packets.CommandPacket((), 0.04, 0.0),
    "too few joints": packets.CommandPacket((0.0,) * (N - 1), 0.04, 0.0),
    "too many joints": packets.CommandPacket((0.0,) * (N + 1), 0.04, 0.0),
    "drive on": packets.DrivePacket(on=True),
    "phase": packets.PhasePacket("rest", {}),
}


@pytest.fixture(scope="module")
def robot():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    yield RobotProcess(SimulatedRobotSettings(robot="panda", scene=open_scene("bare:0")), theirs), ours
    ours.close()
    theirs.close()


@pytest.mark.parametrize("name", INVALID)
def test_an_invalid_command_does_not_feed_the_watchdog(robot, name):
    process, ours = robot
    for packet in (packets.DrivePacket(on=False), packets.DrivePacket(on=True), MOVING):
        process._apply_packet(packet)
    fed_at = process._last_command_at
    time.sleep(0.002)
    for _ in range(3):
        ours.send(packets.encode(INVALID[name]))
        process._receive()
    assert process._last_command_at == fed_at
    process._check_watchdog(fed_at + 0.9 * WATCHDOG_TIMEOUT)
    assert process._off_at is None
    process._check_watchdog(fed_at + 1.1 * WATCHDOG_TIMEOUT)
    assert (process._off_at is not None, process._off_cause) == (True, "watchdog")
    assert not process.plant.read().drive_enabled
    assert np.isfinite(process.plant.read().q).all()


def test_a_valid_command_feeds_the_watchdog(robot):
    process, _ = robot
    process._apply_packet(packets.DrivePacket(on=True))
    before = process._last_command_at
    time.sleep(0.002)
    process._apply_packet(MOVING)
    assert process._last_command_at > before
    process._check_watchdog(process._last_command_at + 0.9 * WATCHDOG_TIMEOUT)
    assert process._off_at is None


def test_a_host_that_stops_the_process_stops_simulated_time(robot, monkeypatch):
    """After a stall of 50 ms no tick follows at once: the robot does not catch up with an old command in force."""
    process, _ = robot
    clock, ticks = [time.monotonic()], []

    def tick():
        ticks.append(clock[0])
        clock[0] += 0.05 if len(ticks) == 5 else 1e-4
        process._shutdown_requested = len(ticks) == 20

    monkeypatch.setattr(simulated_robot.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(process, "_tick", tick)
    monkeypatch.setattr(process, "_receive", lambda: None)
    monkeypatch.setattr(process, "_wait", lambda ahead, due: clock.__setitem__(0, due))
    process.serve()
    gaps = np.diff(ticks)
    assert gaps.max() == pytest.approx(0.05, abs=2e-3)
    assert np.sum(gaps < 0.5e-3) <= 2
