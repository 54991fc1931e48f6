"""A driver at the robot link: its states are sent, its commands applied, and an invalid packet stops it."""

import socket
import struct
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.control_link import COMMAND_PACKET, ControlLink
from dualbrain.control.gatekeeper.robot_link.driver_process import DriverProcess, surveyed_scene
from dualbrain.control.gatekeeper.robot_link.packet_socket import socket_pair
from dualbrain.control.gatekeeper.robot_link.simulated_robot import perception_period_ticks
from dualbrain.control.scene_monitor import SceneMonitor
from dualbrain.records import Scene
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.timing import UR
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from tests.drivers.drivers_under_test import franka, ur

pytestmark = pytest.mark.realtime
TIMEOUT = 20.0
"""Longest time [s] that a test waits for a condition."""


class GatekeeperEnd:
    """The gatekeeper's end of the link; replies to every state with the same packets until a condition holds."""

    def __init__(self, link):
        self.link = link

    def send(self, packet):
        self.link.send(packets.encode(packet))

    def receive_until(self, condition, *replies):
        end = time.monotonic() + TIMEOUT
        while time.monotonic() < end:
            packet = packets.decode_from_robot(self.link.recv(packets.MAX_PACKET_BYTES))
            if isinstance(packet, packets.StatePacket):
                if condition(packet):
                    return packet
                for reply in replies:
                    self.send(reply)
        raise AssertionError("no state met the condition")


@pytest.fixture
def gatekeeper_end():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    ours.settimeout(TIMEOUT)
    driver = ur().driver
    process = DriverProcess(driver, Scene(robot="ur5e", stamp=0.0, version=1, objects=()), theirs)
    thread = threading.Thread(target=process.serve)
    thread.start()
    try:
        yield GatekeeperEnd(ours)
    finally:
        ours.close()
        thread.join(TIMEOUT)
        theirs.close()
    assert not thread.is_alive()
    assert not driver.read().drive_enabled


def is_off(state):
    return not state.drive_enabled


def switch_drive_on(gatekeeper_end):
    gatekeeper_end.send(packets.DrivePacket(on=True))
    gatekeeper_end.receive_until(lambda state: state.drive_enabled, packets.CommandPacket((0.0,) * 6, 0.0, 0.0))


def test_a_command_moves_the_arm_and_its_states_are_sent(gatekeeper_end):
    switch_drive_on(gatekeeper_end)
    start = gatekeeper_end.receive_until(lambda state: True)
    command = packets.CommandPacket((0.2, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0)
    end = gatekeeper_end.receive_until(lambda state: state.q[0] > start.q[0] + 0.01, command)
    assert np.allclose(end.q[1:], start.q[1:], atol=1e-3)


@pytest.mark.parametrize(
    "command",
    [packets.CommandPacket((0.1,) * 5, 0.0, 0.0), packets.CommandPacket((float("nan"),) * 6, 0.0, 0.0)],
    ids=["too few joints", "not finite"],
)
def test_an_invalid_command_ends_the_motion(gatekeeper_end, command):
    switch_drive_on(gatekeeper_end)
    gatekeeper_end.send(command)
    valid = packets.CommandPacket((0.1, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0)
    gatekeeper_end.receive_until(is_off, valid)
    for _ in range(20):
        gatekeeper_end.receive_until(is_off, valid)


def test_bytes_that_are_not_a_packet_end_the_motion(gatekeeper_end):
    switch_drive_on(gatekeeper_end)
    gatekeeper_end.link.send(b"\xff\x00 no packet")
    gatekeeper_end.receive_until(is_off)


def test_the_absence_of_commands_ends_the_motion(gatekeeper_end):
    switch_drive_on(gatekeeper_end)
    gatekeeper_end.receive_until(is_off)


def test_a_surveyed_scene_is_sent_periodically_and_does_not_count_as_frozen():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(TIMEOUT)
    driver, monitor, n_scenes = ur().driver, SceneMonitor(), 0
    process = DriverProcess(driver, surveyed_scene(open_scene("tabletop:1", "ur5e")), theirs)
    every = perception_period_ticks(driver.timing.period)
    for _ in range(10 * every):
        driver.wait()
        process._send_state()
        received = [packets.decode_from_robot(ours.recv(packets.MAX_PACKET_BYTES))]
        if process._ticks % every == 1:
            received.append(packets.decode_from_robot(ours.recv(packets.MAX_PACKET_BYTES)))
        for packet in received:
            if isinstance(packet, packets.ScenePacket):
                n_scenes += 1
                assert not monitor.update(packet.scene) | monitor.age_conditions(packet.scene, packet.scene.stamp)
    assert n_scenes == 10
    assert packet.stamp > 0.0
    ours.close()
    theirs.close()


@pytest.mark.parametrize(
    "packet", [packets.DrivePacket(on=True), packets.PhasePacket("rest", {})], ids=["drive", "phase"]
)
def test_packets_that_are_no_command_do_not_feed_the_watchdog(gatekeeper_end, packet):
    switch_drive_on(gatekeeper_end)
    gatekeeper_end.receive_until(is_off, packet)


def test_a_late_command_of_an_arm_that_continued_by_itself_is_dropped():
    """The command for the state before arrives after the next state; only the one for that state is written."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    driver = franka().driver
    process = DriverProcess(driver, Scene(robot="fr3", stamp=0.0, version=1, objects=()), theirs)
    ours.send(packets.encode(packets.DrivePacket(on=True)))
    ours.send(packets.encode(packets.CommandPacket((0.002,) * 7, 0.0, 0.0)))
    process._drop_late_commands()
    assert driver.read().drive_enabled
    written = []
    driver.write = lambda command: written.append(command.u[0])
    ours.send(packets.encode(packets.CommandPacket((0.001,) * 7, 0.0, 0.0)))
    process._await_command(time.monotonic() + 1.0)
    assert written == [0.001]
    driver.close()
    ours.close()
    theirs.close()


def test_a_malformed_late_command_stops_the_arm():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    driver = franka().driver
    process = DriverProcess(driver, Scene(robot="fr3", stamp=0.0, version=1, objects=()), theirs)
    ours.send(packets.encode(packets.DrivePacket(on=True)))
    ours.send(packets.encode(packets.CommandPacket((float("nan"),) * 7, 0.0, 0.0)))
    process._drop_late_commands()
    assert not driver.read().drive_enabled
    driver.close()
    ours.close()
    theirs.close()


def test_a_drive_that_comes_on_although_it_is_to_be_off_is_stopped():
    ours, theirs = socket_pair()
    driver = RecordedDriver()
    process = DriverProcess(driver, Scene(robot="ur5e", stamp=0.0, version=1, objects=()), theirs)
    driver.wait = process.lose_gatekeeper  # one period
    driver.close = lambda: None
    process.serve()
    assert driver.calls == [("stop",)]
    ours.close()
    theirs.close()


def test_a_fault_of_the_arm_is_logged_once(caplog):
    ours, theirs = socket_pair()
    driver = RecordedDriver()
    process = DriverProcess(driver, Scene(robot="ur5e", stamp=0.0, version=1, objects=()), theirs)
    reports = [(), ("protective stop",), ("protective stop",), (), ("emergency stop",)]

    def report():
        if len(reports) == 1:
            process.lose_gatekeeper()
        return reports.pop(0)

    driver.wait = driver.close = lambda: None
    driver.faults = report
    process.serve()
    assert [record.message for record in caplog.records] == [
        "The arm has switched its drive off: protective stop",
        "The arm has switched its drive off: emergency stop",
    ]
    ours.close()
    theirs.close()


# --- commands of a control thread -----------------------------------------------------------------------------------


class RecordedDriver:
    """A driver that records its calls; its states do not change."""

    timing = UR

    def __init__(self):
        self.calls = []

    def read(self):
        return replace(home_state(load_robot("ur5e")), drive_enabled=True)

    def write(self, command):
        self.calls.append(("write", round(float(command.u[0]), 3)))

    def enable(self):
        self.calls.append(("enable",))

    def stop(self):
        self.calls.append(("stop",))

    def faults(self):
        return ()


class ThreadEnd:
    """The end of a control thread on the link to a driver process that does not run."""

    def __init__(self):
        (link, self.main_end), (self.end, theirs) = socket_pair(), socket_pair()
        self.sockets = (link, self.main_end, self.end, theirs)
        self.driver = RecordedDriver()
        scene = Scene(robot="ur5e", stamp=0.0, version=1, objects=())
        self.process = DriverProcess(self.driver, scene, link, ControlLink(theirs))
        self.main_end.send(packets.encode(packets.CommandPacket((9.0,) * 6, 0.02, 5.0)))
        self.tick = 0

    def send(self, speed, *, drive=True, joints=6):
        self.tick += 1
        head = struct.pack("=IIQII", COMMAND_PACKET, joints, self.tick, drive, 0)
        self.end.send(head + np.full(joints, speed).tobytes())

    def answer(self):
        """The calls of the driver because of the commands that have arrived."""
        self.driver.calls.clear()
        self.process._await_command(time.monotonic() + 0.01)
        return self.driver.calls


@pytest.fixture
def thread_end():
    made = ThreadEnd()
    yield made
    for end in made.sockets:
        end.close()


def test_a_command_from_before_the_drive_was_switched_on_is_not_written(thread_end):
    thread_end.send(0.1)
    assert thread_end.answer() == [("enable",)]
    thread_end.send(0.2)
    assert thread_end.answer() == [("write", 0.2)]


def test_of_several_commands_only_the_newest_is_written(thread_end):
    thread_end.send(0.0)
    thread_end.answer()
    for speed in (0.1, 0.2, 0.3):
        thread_end.send(speed)
    assert thread_end.answer() == [("write", 0.3)]
    assert thread_end.answer() == []


def test_a_drive_that_goes_off_is_not_hidden_by_later_commands(thread_end):
    thread_end.send(0.0)
    thread_end.answer()
    thread_end.send(0.1, drive=False)
    thread_end.send(0.0, drive=False)
    assert thread_end.answer()[0] == ("stop",)


def test_the_speeds_of_the_gatekeeper_do_not_reach_the_arm(thread_end):
    thread_end.send(0.0)
    thread_end.answer()
    thread_end.main_end.send(packets.encode(packets.CommandPacket((9.0,) * 6, 0.03, 5.0)))
    assert thread_end.answer() == []


@pytest.mark.parametrize(("speed", "joints"), [(float("nan"), 6), (0.1, 7)], ids=["not finite", "other joints"])
def test_an_invalid_command_of_the_thread_stops_the_arm(thread_end, speed, joints):
    thread_end.send(0.0)
    thread_end.answer()
    thread_end.send(speed, joints=joints)
    assert set(thread_end.answer()) == {("stop",)}
