"""The firmware on an emulated Cortex-M: the same bits as the host, refused messages, and the loss of host or target."""

import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import IDENTITY_POSE, Box, Capsule, Pose, Sphere
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import obstacle_table
from dualbrain.safety.cbf.obstacles import Contact, NearSpeed, Obstacle
from dualbrain.safety.cbf.rows import ConstraintRow
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.target.boards import find_board
from dualbrain.safety.target.build import Firmware, build_firmware
from dualbrain.safety.target.emulated_board import EmulatedBoard
from dualbrain.safety.target.frames import FrameReader, decode_frame, encode_frame
from dualbrain.safety.target.messages import (
    CYCLE,
    Message,
    obstacle_frames,
    pack_held,
    pack_permits,
    pack_rows,
    padded,
    parse_cycle_reply,
)
from dualbrain.safety.target.robot_tables import robot_tables_hash
from dualbrain.safety.target.session import TargetLostError, TargetSession
from dualbrain.safety.target.target_filter import EmulatedTarget

PANDA, BASE = load_robot("panda"), load_robot("base")
CONFIG = operating_config(PANDA)
KEY = bytes(range(16))
V_MAX = np.array([joint.velocity.value for joint in PANDA.joints])
HOME = np.array(PANDA.home)


@pytest.fixture(scope="module")
def lockstep():
    with EmulatedTarget("an386", PANDA, CONFIG) as target:
        yield target


@pytest.fixture(scope="module")
def own_clock(tmp_path_factory):
    """Firmware that runs by its own clock, behind a serial line."""
    firmware = Firmware(board=find_board("an505"), key=KEY, link="uart", lockstep=False)
    return build_firmware(firmware, PANDA, CONFIG, tmp_path_factory.mktemp("firmware"))


def obstacles(rng):
    """Spheres, capsules and boxes around the arm, none of them in it; a third moves, one limits the speed near it."""
    shapes = (Sphere(0.05), Capsule(0.03, 0.1), Box((0.05, 0.03, 0.08)))
    found = [
        Obstacle(name="floor", shape=Box((1.0, 1.0, 0.05)), pose=Pose((0.0, 0.0, -0.1), IDENTITY_POSE.quaternion)),
    ]
    while len(found) < 13:
        position = rng.uniform((-0.8, -0.8, 0.0), (0.8, 0.8, 1.0))
        if np.linalg.norm(position - (0.2, 0.0, 0.5)) > 0.42 and np.linalg.norm(position[:2]) > 0.3:
            k = len(found)
            moves = k % 3 == 0
            found.append(
                Obstacle(
                    name=f"o{k}",
                    shape=shapes[k % 3],
                    pose=Pose(tuple(position), IDENTITY_POSE.quaternion),
                    velocity=(0.05, -0.02, 0.0) if moves else (0.0, 0.0, 0.0),
                    velocity_error=0.02 * moves,
                    margin=0.005,
                    static=not moves,
                    near=NearSpeed(0.3) if k == 6 else None,
                )
            )
    return found


def states(rng, steps):
    """Time, nominal control, and its index: bang-bang controls toward random directions."""
    for i in range(steps):
        if i % 120 == 0:
            u_nom = rng.choice([-1.0, 1.0], len(V_MAX)) * V_MAX
        yield i, 1e-3 * i, u_nom


def test_every_step_has_the_bits_of_the_host(lockstep):
    """Obstacles, contacts, a held object, rows, unknown openings and rejected input; no bit differs."""
    rng = np.random.default_rng(3)
    safety, q, u = lockstep.filter(), HOME.copy(), np.zeros(7)
    scene, statuses = obstacles(rng), set()
    for i, now, u_nom in states(rng, 900):
        if i % 33 == 0:
            safety.observe(scene, now)
        if i == 200:
            safety.permit([Contact("hand", "o4", 0.05), Contact("fingers", "floor", 0.1)])
            safety.attach([[0.0, 0.0, 0.05, 0.03]], 0.004)
        if i == 400:
            safety.detach()
            safety.constrain([ConstraintRow(name="slow", a=(1.0, *[0.0] * 6), b=-0.1)])
        opening = None if i % 7 == 0 else 0.02
        given = np.full(7, np.nan) if i == 600 else q
        late = 1.0 if i == 700 else 0.0
        result = safety(given, u, u_nom, now + late, opening)
        statuses.add(result.status.name)
        u, q = result.u, q + 1e-3 * result.u
    assert {"MODIFIED", "STOPPED"} <= statuses
    assert (safety.target.lost, safety.target.steps, safety.target.differences) == ("", 900, 0)
    assert safety.describe_target() == "an386: 900 steps on target and host, 0 with different bits"


def controller_on(target):
    safety = target.filter()
    safety.observe((), 0.0)
    return SafetyController(safety)


def tick(controller, i, conditions=0, u_nom=0.0):
    """One tick of a controller at rest at home."""
    now = 1e-3 * i
    state = RobotState(stamp=now, sequence=i, q=HOME, v=np.zeros(7), opening=0.02, finger_forces=(0.0, 0.0))
    controller.accept_state(state, now)
    decision = controller.decide(state, now, int(conditions))
    return decision, controller.control(state, np.full(7, u_nom), now)


def test_the_target_decides_as_the_host_and_latches_an_emergency_stop(lockstep):
    controller = controller_on(lockstep)
    target = controller.safety.target
    given = [0, Condition.PAUSE, Condition.SCENE_FROZEN, 0, Condition.ESTOP, 0, Condition.RESUME, 0, Condition.RESET]
    for i in range(10):  # conditions of earlier tests pass
        tick(controller, 5000 + 50 * i)
    for i, conditions in enumerate([*given, 0, Condition.RESUME, *[0] * 40]):
        decision, _ = tick(controller, 5500 + 10 * i, conditions)
        assert target.reply.action == decision.action
        if conditions == Condition.ESTOP:
            assert not target.reply.drive_enabled
            assert not lockstep.board.link.drive_enabled
    assert decision.action < SafetyAction.HOLD
    assert lockstep.board.link.drive_enabled


def test_a_button_at_the_target_stops_the_host_too(lockstep):
    controller = controller_on(lockstep)
    tick(controller, 7000)
    lockstep.board.link.press_estop(pressed=True)
    try:
        tick(controller, 7001)
        assert not lockstep.board.link.drive_enabled
        decision, _ = tick(controller, 7002)
        assert (decision.check, controller.drive_wanted) == ("estop", False)
    finally:
        lockstep.board.link.press_estop(pressed=False)
    tick(controller, 7003)
    tick(controller, 7103, Condition.RESET)
    tick(controller, 7203, Condition.RESUME)


def test_a_control_with_another_bit_is_reported_and_the_arm_brakes(lockstep):
    controller = controller_on(lockstep)
    for i in range(7210, 8000, 10):  # the host follows a stop of the target that is left of earlier tests
        tick(controller, i, Condition.RESUME if i == 7990 else 0)
    decision, _ = tick(controller, 8000)
    assert decision.action < SafetyAction.HOVER
    host = controller.safety.target._host
    host.reset(np.full(7, 0.01), np.zeros(7))  # the channels differ
    tick(controller, 8001, u_nom=2.0)
    assert controller.safety.target.differences == 1
    decision, _ = tick(controller, 8002)
    assert decision.check == "control_bad"


NO_HELD, NO_ROWS = pack_held(np.zeros((0, 4)), 0.0), pack_rows(np.zeros((0, 10)), 7)


@pytest.fixture
def session(lockstep):
    """The session, with a held object and additional rows that are valid after the tests before."""
    lockstep.session.send(Message.HELD, NO_HELD)
    lockstep.session.send(Message.ROWS, NO_ROWS)
    return lockstep.session


def cycle_payload(now=3.0, q=HOME, conditions=0):
    times = (round(now * 1e6), round(now * 1e6), int(conditions))
    return CYCLE.pack(*times, *padded(q), *padded([0.0] * 7), *padded([0.1] * 7), 0.02, 0.0, 0.0, 1, *[0.0] * 12)


def refused_by(session, send):
    """How many frames the target refused because of `send`."""
    for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
        session.send(kind, payload)
    before = session.cycle(cycle_payload()).refused
    send()
    return session.cycle(cycle_payload()).refused - before


def encoded_frame(session, kind, payload, *, ahead=1, key=None):
    session._sequence += max(0, ahead)
    return encode_frame(kind, session._sequence + min(0, ahead), payload, key or session._key)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("torn", lambda session: encoded_frame(session, 9, cycle_payload())[:-40] + b"\0"),
        ("forged", lambda session: encoded_frame(session, 9, cycle_payload(), key=bytes(16))),
        ("replayed", lambda session: encoded_frame(session, 9, cycle_payload(), ahead=0)),
        ("of an earlier number", lambda session: encoded_frame(session, 9, cycle_payload(), ahead=-3)),
        ("of an unknown type", lambda session: encoded_frame(session, 0x55, b"")),
        ("of the other direction", lambda session: encoded_frame(session, Message.CYCLE_REPLY, bytes(80))),
        ("too short", lambda session: encoded_frame(session, 9, cycle_payload()[:-1])),
        ("too long for the reader", lambda session: b"\1" * 3000 + b"\0"),
        ("with too many obstacles", lambda session: encoded_frame(session, Message.SCENE_BEGIN, b"\xff\xff")),
        (
            "with obstacles without a beginning",
            lambda session: encoded_frame(session, Message.OBSTACLES, bytes(4 + 132)),
        ),
        (
            "with obstacles that are not the next ones",
            lambda session: (
                encoded_frame(session, Message.SCENE_BEGIN, b"\2\0")
                + encoded_frame(session, Message.OBSTACLES, b"\1\0\1\0" + bytes(132))
            ),
        ),
        ("with a permit for no obstacle", lambda session: encoded_frame(session, Message.PERMITS, b"\1\0" + bytes(8))),
        (
            "with a held object of 9 spheres",
            lambda session: encoded_frame(session, Message.HELD, b"\x09\0" + bytes(6 + 144)),
        ),
        ("with a last control beyond the limits", lambda session: encoded_frame(session, Message.RESET, b"\x7f" * 64)),
    ],
)
def test_a_bad_message_is_refused_and_counted(session, name, change):
    assert refused_by(session, lambda: session.link.write(change(session))) == 1


def test_a_new_scene_permits_no_contact(session):
    """A pair with a permit does not count for h_min; the permit ends with its scene."""
    centres, radii, _ = SafetyFilter(PANDA).spheres(HOME, 0.02)
    front = int(np.argmax(centres[:, 0] + radii))
    position = centres[front] + (radii[front] + 0.028, 0.0, 0.0)  # 8 mm before the foremost sphere of the arm
    pose = Pose(tuple(position.tolist()), IDENTITY_POSE.quaternion)
    table = obstacle_table([Obstacle(name="ball", shape=Sphere(0.02), pose=pose)])

    def h_min(permits):
        for kind, payload in obstacle_frames(table, {}):
            session.send(kind, payload)
        if permits:
            links = range(len(PANDA.links))
            session.send(Message.PERMITS, pack_permits([(link, 0, 0.05) for link in links]))
        return session.cycle(cycle_payload()).h_min

    before = h_min(permits=False)
    assert h_min(permits=True) > before
    assert h_min(permits=False) == before


def test_the_target_itself_zeroes_the_nominal_control_under_a_pause(session):
    """A host that passes a pause and a motion on does not move the arm."""
    for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
        session.send(kind, payload)
    for tick in range(8):  # conditions of earlier tests pass
        session.cycle(cycle_payload(19.0 + 0.1 * tick, conditions=Condition.CONTINUE if tick == 7 else 0))
    session.send(Message.RESET, bytes(64))
    paused = session.cycle(cycle_payload(20.0, conditions=Condition.PAUSE))
    assert (paused.action, paused.u.any()) == (SafetyAction.HOVER, False)
    assert session.cycle(cycle_payload(20.1)).u[:7].all()


def has_bad_scene(session):
    reply = session.cycle(cycle_payload())
    assert (reply.status == 3) == bool(reply.flags & 256)
    return reply.status == 3


def send_scene(session):
    for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
        session.send(kind, payload)


def test_after_a_scene_that_was_refused_every_step_brakes_until_the_next_one(session):
    """Neither the held object nor additional rows bring the former obstacles into force again."""
    session.send(Message.SCENE_BEGIN, b"\xff\xff")
    assert has_bad_scene(session)
    for kind, payload in ((Message.HELD, NO_HELD), (Message.ROWS, NO_ROWS), (Message.PERMITS, pack_permits([]))):
        session.send(kind, payload)
        assert has_bad_scene(session)
    send_scene(session)
    assert not has_bad_scene(session)


@pytest.mark.parametrize(("kind", "valid"), [(Message.HELD, NO_HELD), (Message.ROWS, NO_ROWS)])
def test_after_a_refused_part_every_step_brakes_until_the_same_part_is_valid(session, kind, valid):
    send_scene(session)
    session.send(kind, b"\xff\xff")
    assert has_bad_scene(session)
    send_scene(session)
    session.send(Message.ROWS if kind == Message.HELD else Message.HELD, NO_ROWS if kind == Message.HELD else NO_HELD)
    assert has_bad_scene(session)
    session.send(kind, valid)
    assert not has_bad_scene(session)


def test_a_new_session_has_no_scene_until_the_host_sends_one(lockstep):
    new = TargetSession(lockstep.board.link, lockstep.session._shared, robot_tables_hash(PANDA, CONFIG))
    for kind, payload in ((Message.HELD, NO_HELD), (Message.ROWS, NO_ROWS)):
        new.send(kind, payload)
    assert has_bad_scene(new)
    send_scene(new)
    assert not has_bad_scene(new)
    lockstep.session._key, lockstep.session._sequence = new._key, new._sequence


def test_a_replayed_hello_ends_the_session_and_changes_nothing_else(lockstep):
    """Both nonces enter the key of a session, so that no message of the former session is accepted."""
    first = TargetSession(lockstep.board.link, lockstep.session._shared, robot_tables_hash(PANDA, CONFIG))
    TargetSession(lockstep.board.link, lockstep.session._shared, robot_tables_hash(PANDA, CONFIG))
    first.link.write(encode_frame(Message.CYCLE, first._sequence + 50, cycle_payload(), first._key))
    assert first.listen(0.05) == []
    restored = TargetSession(lockstep.board.link, lockstep.session._shared, robot_tables_hash(PANDA, CONFIG))
    lockstep.session._key, lockstep.session._sequence = restored._key, restored._sequence


def test_tables_of_another_robot_are_refused_by_name(lockstep):
    with pytest.raises(ConfigurationError, match=f"{robot_tables_hash(PANDA, CONFIG):016x}"):
        TargetSession(lockstep.board.link, lockstep.session._shared, 1)
    stranger = TargetSession.__new__(TargetSession)
    stranger.__dict__.update(link=lockstep.board.link, _shared=lockstep.session._shared, _reader=FrameReader())
    stranger.__dict__.update(_sequence=0, outputs=[])
    stranger._open(1)
    stranger.send(Message.CYCLE, cycle_payload())
    assert stranger._receive(Message.CYCLE_REPLY, stranger._sequence, 0.1) is None, "no session is open"
    restored = TargetSession(lockstep.board.link, lockstep.session._shared, robot_tables_hash(PANDA, CONFIG))
    lockstep.session._key, lockstep.session._sequence = restored._key, restored._sequence


def test_an_unknown_board_and_a_short_key_are_named():
    with pytest.raises(UnknownNameError, match="an386"):
        find_board("an999")
    with pytest.raises(ConfigurationError, match="key"):
        build_firmware(Firmware(board=find_board("an386"), key=b"short"), PANDA, CONFIG, "unused")


@pytest.mark.realtime  # the clock of the board runs on while this process waits for a processor
def test_without_a_host_the_watchdog_brakes_then_switches_the_drive_off(own_clock):
    """At full speed: the control falls by at most one period's acceleration per output, and is never raised."""
    with EmulatedBoard(find_board("an505"), own_clock, link="uart") as board:
        session = TargetSession(board.link, KEY, robot_tables_hash(PANDA, CONFIG))
        for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
            session.send(kind, payload)
        for i in range(30):
            reply = session.cycle(cycle_payload(1e-3 * i))
        assert np.all(reply.u[:7] > 0.05)
        outputs = session.listen(0.6)
    speeds = [float(np.abs(one.u).max()) for one in [reply, *outputs]]
    assert all(later <= earlier for earlier, later in pairwise(speeds))
    assert speeds[-1] == 0.0
    assert CHECKS[outputs[0].check].name == "state_stale"
    assert outputs[0].action == SafetyAction.CONTROLLED_STOP
    assert CHECKS[outputs[-1].check].name == "state_lost"
    assert (outputs[-1].action, outputs[-1].drive_enabled) == (SafetyAction.ESTOP, False)


@pytest.fixture(scope="module")
def slow_base(tmp_path_factory):
    """Firmware of the mobile base, whose period is 20 ms, by its own clock."""
    firmware = Firmware(board=find_board("an386"), key=KEY, lockstep=False)
    return build_firmware(firmware, BASE, operating_config(BASE), tmp_path_factory.mktemp("firmware"))


def cycle_replies(session, seconds):
    """The replies to CYCLEs that arrive in `seconds`."""
    replies, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        for piece in session._reader.feed(session.link.read(left)):
            frame = decode_frame(piece, session._key)
            replies += [frame] if frame is not None and frame.type == Message.CYCLE_REPLY else []
    return replies


def accepted_cycles(session, count):
    """Send `count` CYCLEs without a pause, then one at a time until the last is answered.

    The board answers in the order of the frames, so that no reply is left. Returns the number of all that were sent,
    and the replies.
    """
    for _ in range(count):
        session.send(Message.CYCLE, cycle_payload(q=BASE.home))
    replies, end = [], time.monotonic() + 30.0
    while time.monotonic() < end:
        replies += cycle_replies(session, 0.3)  # more than 8 periods
        sequence = session.send(Message.CYCLE, cycle_payload(q=BASE.home))
        count += 1
        replies += cycle_replies(session, 0.3)
        if replies and replies[-1].sequence == sequence:
            return count, replies
    raise AssertionError(f"the board does not answer: {len(replies)} replies")


@pytest.mark.realtime  # the clock of the board runs on while this process waits for a processor
def test_a_host_that_sends_faster_than_the_period_is_refused(slow_base):
    """Each cycle may change the control by one period's acceleration: n periods accept at most n cycles and a few."""
    with EmulatedBoard(find_board("an386"), slow_base) as board:
        session = TargetSession(board.link, KEY, robot_tables_hash(BASE, operating_config(BASE)))
        for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
            session.send(kind, payload)
        started = time.monotonic()
        sent, replies = accepted_cycles(session, 100)
        periods = (time.monotonic() - started) / BASE.period
        assert 1 <= len(replies) <= 5 + periods * 64 / 63 < 100
        assert parse_cycle_reply(replies[-1].payload).refused == sent - len(replies)
        time.sleep(8 * BASE.period)
        sent, replies = accepted_cycles(session, 4)
        assert len(replies) == sent  # a late host may catch up


RUNNING_AWAY = """
#include "executive/executive.h"
#include "port/hal.h"
void __real_executive_watchdog(executive *e, uint64_t now_us);
void __wrap_executive_watchdog(executive *e, uint64_t now_us) {
  while (e->refused) { hal_watchdog(); }
  __real_executive_watchdog(e, now_us);
}
"""
"""Feeds the hardware watchdog without a pause, as a program whose loop has lost its rhythm."""
HANGING = """
#include "executive/executive.h"
void __real_executive_watchdog(executive *e, uint64_t now_us);
void __wrap_executive_watchdog(executive *e, uint64_t now_us) {
  while (e->refused) {}
  __real_executive_watchdog(e, now_us);
}
"""


HOLDING_A_BOARD = """
import sys, time
from pathlib import Path
from dualbrain.safety.target.boards import find_board
from dualbrain.safety.target.emulated_board import EmulatedBoard
with EmulatedBoard(find_board("an386"), Path(sys.argv[1])) as board:
    print(board.process.pid, flush=True)
    time.sleep(60)
"""


def command_line(pid):
    """The command line of a process, empty if it has ended."""
    try:
        return Path("/proc", str(pid), "cmdline").read_bytes()
    except OSError:
        return b""


def test_a_killed_program_leaves_no_emulator(slow_base):
    with subprocess.Popen([sys.executable, "-c", HOLDING_A_BOARD, slow_base], stdout=subprocess.PIPE) as program:
        pid = int(program.stdout.readline())
        assert b"qemu" in command_line(pid)
        program.kill()
    deadline = time.monotonic() + 10.0
    while command_line(pid):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_the_main_loop_feeds_the_watchdog_in_its_rhythm(slow_base):
    """Neither too early nor too late, although the emulator is paused now and then; no host is needed."""
    with EmulatedBoard(find_board("an386"), slow_base) as board:
        time.sleep(0.5)
        assert board.process.poll() is None


@pytest.mark.realtime
@pytest.mark.parametrize(("name", "fault"), [("an386", HANGING), ("an505", HANGING), ("an500", RUNNING_AWAY)])
def test_firmware_that_hangs_or_runs_away_is_stopped_by_the_hardware_watchdog(tmp_path, name, fault):
    source = tmp_path / "faulty.c"
    source.write_text(fault)  # a refused frame starts the fault of this main loop
    extra = ("-Wl,--wrap=executive_watchdog", str(source))
    firmware = Firmware(board=find_board(name), key=KEY, lockstep=False, extra=extra)
    with EmulatedBoard(find_board(name), build_firmware(firmware, PANDA, CONFIG, tmp_path / "build")) as board:
        session = TargetSession(board.link, KEY, robot_tables_hash(PANDA, CONFIG))
        for kind, payload in obstacle_frames(np.zeros((0, 29)), {}):
            session.send(kind, payload)
        assert session.cycle(cycle_payload()).drive_enabled
        assert board.link.drive_enabled
        session.listen(0.04)  # more than one period of the watchdog
        assert board.process.poll() is None
        session.send(Message.CYCLE, b"too short")
        assert board.process.wait(10.0) == 99  # the handler of faults
        assert not board.link.drive_enabled


def test_a_lost_target_is_an_emergency_stop_that_names_the_target(monkeypatch):
    monkeypatch.setattr("dualbrain.safety.target.session.REPLY_TIMEOUT_S", 0.5)
    with EmulatedTarget("an386", PANDA, CONFIG) as target:
        controller = controller_on(target)
        tick(controller, 0)
        target.board.process.kill()
        target.board.process.wait()
        started = time.monotonic()
        _, result = tick(controller, 1)
        decision, _ = tick(controller, 2)
    assert "did not answer" in controller.safety.target.lost
    assert (decision.check, controller.drive_wanted) == ("program_error", False)
    assert not result.u.any()
    assert time.monotonic() - started < 10.0


def test_no_target_behind_a_link_is_an_error_that_names_the_key(own_clock, monkeypatch):
    monkeypatch.setattr("dualbrain.safety.target.session.HELLO_TIMEOUT_S", 0.3)
    with (
        EmulatedBoard(find_board("an505"), own_clock, link="uart") as board,
        pytest.raises(TargetLostError, match="same key"),
    ):
        TargetSession(board.link, bytes(16), robot_tables_hash(PANDA, CONFIG))
