"""A driver on the wire: its states are told, its orders obeyed, and what is no order for it stops it."""

import socket
import threading
import time

import numpy as np
import pytest

from dualbrain.control.gatekeeper.robot_link import packets as bus
from dualbrain.control.gatekeeper.robot_link.driver_process import DriverProcess, surveyed_scene
from dualbrain.control.gatekeeper.robot_link.simulated_robot import perception_period_ticks
from dualbrain.control.scene_monitor import SceneMonitor
from dualbrain.records import Scene
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from tests.drivers.drivers_under_test import ur

PATIENCE = 20.0


class Wire:
    """Our end: answers every state with the same words until a state is as wanted."""

    def __init__(self, link):
        self.link = link

    def say(self, packet):
        self.link.send(bus.encode(packet))

    def until(self, wanted, *words):
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            packet = bus.decode_from_robot(self.link.recv(bus.MAX_PACKET_BYTES))
            if isinstance(packet, bus.StatePacket):
                if wanted(packet):
                    return packet
                for word in words:
                    self.say(word)
        raise AssertionError("no such state came")


@pytest.fixture
def wire():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    ours.settimeout(PATIENCE)
    driver = ur().driver
    process = DriverProcess(driver, Scene(robot="ur5e", stamp=0.0, version=1, objects=()), theirs)
    thread = threading.Thread(target=process.serve)
    thread.start()
    try:
        yield Wire(ours)
    finally:
        ours.close()
        thread.join(PATIENCE)
        theirs.close()
    assert not thread.is_alive()
    assert not driver.read().drive_enabled


def driven(wire):
    wire.say(bus.DrivePacket(on=True))
    wire.until(lambda state: state.driven, bus.CommandPacket((0.0,) * 6, 0.0, 0.0))


def test_what_is_written_moves_the_arm_and_is_told(wire):
    driven(wire)
    start = wire.until(lambda state: True)
    word = bus.CommandPacket((0.2, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0)
    there = wire.until(lambda state: state.q[0] > start.q[0] + 0.01, word)
    assert np.allclose(there.q[1:], start.q[1:], atol=1e-3)


@pytest.mark.parametrize(
    "rubbish", [bus.CommandPacket((0.1,) * 5, 0.0, 0.0), bus.CommandPacket((float("nan"),) * 6, 0.0, 0.0)]
)
def test_a_command_that_is_none_for_this_arm_ends_the_motion(wire, rubbish):
    driven(wire)
    wire.say(rubbish)
    good = bus.CommandPacket((0.1, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0)
    wire.until(lambda state: not state.driven, good)
    for _ in range(20):
        wire.until(lambda state: not state.driven, good)


def test_bytes_that_are_no_packet_end_the_motion(wire):
    driven(wire)
    wire.link.send(b"\xff\x00 no packet")
    wire.until(lambda state: not state.driven)


def test_silence_ends_the_motion(wire):
    driven(wire)
    wire.until(lambda state: not state.driven)


def test_a_surveyed_scene_is_told_for_ever_and_is_no_camera_that_hangs():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(PATIENCE)
    driver, watch, looks = ur().driver, SceneMonitor(), 0
    process = DriverProcess(driver, surveyed_scene(open_scene("tabletop:1", "ur5e")), theirs)
    every = perception_period_ticks(driver.timing.period)
    for _ in range(10 * every):
        driver.wait()
        process._send_state()
        packets = [bus.decode_from_robot(ours.recv(bus.MAX_PACKET_BYTES))]
        if process._ticks % every == 1:
            packets.append(bus.decode_from_robot(ours.recv(bus.MAX_PACKET_BYTES)))
        for packet in packets:
            if isinstance(packet, bus.ScenePacket):
                looks += 1
                assert not watch.update(packet.scene) | watch.age_conditions(packet.scene, packet.scene.stamp)
    assert looks == 10
    assert packet.stamp > 0.0
    ours.close()
    theirs.close()
