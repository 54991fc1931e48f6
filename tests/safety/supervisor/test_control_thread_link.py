"""The control thread and the program or process of the robot: commands, the drive, clocks, and bad states."""

import socket
import struct
from contextlib import suppress
from dataclasses import replace
from math import inf, nan

import msgspec
import numpy as np
import pytest

from dualbrain.robots.interface import home_state
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.control_thread import ControlThread, ControlThreadConfig, ControlThreadError
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import SIMULATED

PERIOD = 0.001003
"""No multiple of it is a threshold of a check [s]."""
ANY_SCHEDULING = ControlThreadConfig(priority=0)


@pytest.fixture(scope="module")
def arm(sparse_panda):
    """Without the supervision of contact forces, which the loop in C does not have."""
    return msgspec.structs.replace(sparse_panda, force_sensing=None)


class Program:
    """A robot program that passes states of an arm at home to a control loop on a virtual clock."""

    def __init__(self, robot_model, **options):
        self.model, self.now, self.sequence = robot_model, 1.0, 0
        self.loop = ControlThread(SafetyFilter(robot_model), ANY_SCHEDULING, **options)

    def state(self, **changes):
        self.now, self.sequence = self.now + PERIOD, self.sequence + 1
        values = {"stamp": round(self.now * 1e6) / 1e6, "sequence": self.sequence, "v": np.zeros(self.model.n)}
        return replace(home_state(self.model), **values | changes)

    def ticks(self, count, **changes):
        for _ in range(count):
            self.loop.push_state(self.state(**changes))
            self.loop.submit_control(np.full(self.model.n, 0.1))
            self.loop.tick(self.now)
        return self.loop.read_log()


def test_a_program_that_takes_commands_late_gets_the_newest_one(arm):
    """The ring holds 64 commands; without the newest one the program would not know that the drive is to be off."""
    program = Program(arm)
    assert all(drive for _, _, drive in (program.ticks(10), program.loop.pop_commands())[1])
    program.ticks(100)
    program.loop.estop()
    program.ticks(100)
    commands = program.loop.pop_commands()
    assert [tick for tick, _, _ in commands] == [*range(11, 75), 210]
    assert commands[-1][1:] == ((0.0,) * arm.n, False)
    assert program.loop.pop_commands() == []
    program.ticks(2)
    assert [tick for tick, _, _ in program.loop.pop_commands()] == [211, 212]


def test_the_last_command_after_a_stop_switches_the_drive_off(arm):
    """A stop of an arm that moves takes longer than the ring of commands holds."""
    program = Program(arm)
    program.loop.start()
    for _ in range(10):
        program.loop.push_state(program.state(stamp=program.loop.clock(), v=np.full(arm.n, 0.1)))
    program.loop.stop()
    assert program.loop.status().finished
    assert program.loop.pop_commands()[-1][1:] == ((0.0,) * arm.n, False)
    assert program.loop.read_log()["action"][-1] >= SafetyAction.CONTROLLED_STOP


def test_the_last_record_of_a_stop_that_takes_too_long_states_the_last_command(arm):
    """A silent robot that is not at rest while its drive is being switched on: the drive goes off after 2 s."""
    program = Program(arm, timing=msgspec.structs.replace(SIMULATED, drive_on_silence=5.0))
    program.loop.push_state(program.state(stamp=program.loop.clock(), v=np.full(arm.n, 0.05), drive_enabled=False))
    program.loop.start()
    program.loop.stop()
    records = program.loop.read_log()
    assert records["drive_enable"].tolist() == [1] * (len(records) - 1) + [0]
    assert int(records["now_us"][-1]) - int(records["now_us"][0]) >= 2_000_000
    tick, u, drive = program.loop.pop_commands()[-1]
    assert (tick, drive) == (records["tick"][-1], bool(records["drive_enable"][-1]))
    assert np.array_equal(u, records["u"][-1, : arm.n])


def test_a_tick_before_the_first_state_states_no_check(arm):
    program = Program(arm)
    program.loop.tick(program.now)
    assert program.loop.read_log()["check"].tolist() == [255]
    assert program.loop.pop_commands() == []


def test_a_drive_that_the_caller_switches_off_comes_on_again_only_at_rest(arm):
    """The control begins at zero, so the drive of a moving arm would stop it beyond its limit of the acceleration."""
    limits = np.array([joint.acceleration.value for joint in arm.joints])
    thread, now = ControlThread(SafetyFilter(arm), ANY_SCHEDULING, simulated_at=arm.home), 1.0

    def run(seconds):
        nonlocal now
        for _ in range(round(seconds / PERIOD)):
            now += PERIOD
            thread.submit_control(np.full(arm.n, 0.3))
            thread.tick(now)
        return thread.read_log()

    assert run(0.3)["state_v"][-1, 0] == pytest.approx(0.3, rel=0.01)
    thread.set_drive(on=False)
    run(0.003)
    thread.set_drive(on=True)
    records = run(0.3)
    assert not records["drive_enable"][0]
    assert records["drive_enable"][-1]
    assert np.abs(records["u"][-1]).max() > 0.1
    assert (np.abs(np.diff(records["state_v"][:, : arm.n], axis=0)) <= 1.1 * limits * PERIOD).all()
    assert (records["drive_off"] != records["drive_enable"]).all()
    came_on = np.flatnonzero(records["drive_enable"])[0]
    assert np.abs(records["state_v"][came_on]).max() < 0.01


UNUSABLE_STATES = {
    "stamp_nan": {"stamp": nan},
    "stamp_infinite": {"stamp": inf},
    "stamp_beyond_all_clocks": {"stamp": 1e300},
    "too_few_positions": {"q": np.zeros(6)},
    "a_velocity_for_all_joints": {"v": np.zeros(())},
    "too_many_desired_velocities": {"desired_v": np.zeros(8), "desired_a": np.zeros(7)},
}


@pytest.mark.parametrize("name", UNUSABLE_STATES)
def test_a_state_that_lacks_a_value_stops_the_arm(arm, name):
    program = Program(arm)
    assert program.ticks(20)["drive_enable"].all()
    records = program.ticks(1, **UNUSABLE_STATES[name])
    assert records["conditions"][-1] & int(Condition.STATE_IMPLAUSIBLE)
    assert records["action"][-1] == SafetyAction.CONTROLLED_STOP


@pytest.mark.parametrize("sequence", [-1, 2**70])
def test_a_number_of_a_state_beyond_those_of_the_loop_is_no_error(arm, sequence):
    program = Program(arm)
    program.ticks(20)
    repeated = int(Condition.STATE_REPEATED) if sequence < 0 else int(Condition.STATE_MISSED)
    assert program.ticks(1, sequence=sequence)["conditions"][-1] & repeated


def test_a_thread_is_started_once(arm):
    thread = ControlThread(SafetyFilter(arm), ANY_SCHEDULING, simulated_at=arm.home)
    thread.start()
    with pytest.raises(ControlThreadError, match="runs already"):
        thread.start()
    thread.stop()
    with pytest.raises(ControlThreadError, match=r"stopped.*Make a ControlThread"):
        thread.start()


# --- a robot process behind a socket ------------------------------------------------------------------------------


class Process:
    """A robot process whose clock began long ago, and a control loop that calls on a virtual clock."""

    def __init__(self, robot_model, **config):
        link, self.socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.model, self.sequence, self.now = robot_model, 0, 1.0
        settings = ControlThreadConfig(priority=0, **config)
        self.loop = ControlThread(SafetyFilter(robot_model), settings, link=link)

    def send_state(self, stamp_us, v=0.0):
        self.sequence += 1
        head = struct.pack("=IIQQdII", 0x31534244, self.model.n, self.sequence, stamp_us, nan, True, False)
        self.socket.send(head + np.concatenate((self.model.home, np.full(self.model.n, v))).tobytes())

    def ticks(self, count):
        for _ in range(count):
            self.now += PERIOD
            self.loop.tick(self.now)


def is_drive_wanted(command):
    """Whether a packet of a command wants the drive on."""
    return struct.unpack_from("=IIQI", command)[3] == 1


@pytest.fixture
def process(arm):
    made = Process(arm, caller_lost_after=0.3)
    yield made
    made.loop.stop()
    made.socket.close()


def test_a_thread_that_is_forgotten_switches_the_drive_off_before_its_socket_is_closed(arm):
    process = Process(arm)
    process.loop.start()
    process.send_state(round(process.loop.clock() * 1e6), v=0.1)
    process.socket.settimeout(2.0)
    assert is_drive_wanted(process.socket.recv(4096))
    del process.loop
    packets = [*iter(lambda: process.socket.recv(4096), b"")]
    process.socket.close()
    assert not is_drive_wanted(packets[-1])


def records_after_a_late_start(process, n_states):
    """The log of a caller that reads it once before the first state of the robot, and again after `n_states`."""
    process.loop.read_log()
    process.ticks(10)
    for tick in range(n_states):
        process.send_state(5_000_000_000 + 1003 * tick)
        process.ticks(1)
    return process.loop.read_log()


def test_a_caller_that_waits_for_the_first_state_of_the_robot_is_not_lost(process):
    records = records_after_a_late_start(process, 200)
    assert records["now_us"][0] == 0
    assert records["now_us"][-1] > 5_000_000_000
    assert records["drive_enable"][-1]
    assert records["action"].max() < SafetyAction.CONTROLLED_STOP


def test_a_caller_that_hangs_since_the_first_state_of_the_robot_is_lost(process):
    records = records_after_a_late_start(process, 400)
    assert records["action"][-1] == SafetyAction.CONTROLLED_STOP
    assert not records["drive_enable"][-1]


@pytest.mark.parametrize("malformed", [False, True])
def test_packets_that_come_faster_than_the_period_do_not_pace_the_ticks(arm, malformed):
    """Every tick may change the control by the acceleration of one period."""
    process = Process(arm)
    process.socket.setblocking(False)
    process.loop.start()
    began = process.loop.clock()
    while process.loop.clock() - began < 0.3:
        with suppress(BlockingIOError):
            process.socket.send(b"no state") if malformed else process.send_state(round(process.loop.clock() * 1e6))
        with suppress(BlockingIOError):
            process.socket.recv(4096)
    process.loop.stop()
    elapsed = process.loop.clock() - began
    process.socket.close()
    assert len(process.loop.read_log()) <= elapsed / (arm.period * 63 / 64) + 6
