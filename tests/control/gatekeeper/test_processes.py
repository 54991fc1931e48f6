"""Two processes and a robot: contracts, people's hands, and a cortex that dies, hangs, floods or talks rubbish."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol import client as client_module
from dualbrain.control.gatekeeper.protocol.authentication import contract_mac, load_or_create_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Heartbeat, Propose, RequestRefused, encode_body, kind_code
from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG_TIMEOUT, RobotReport
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from tests.control.gatekeeper.commander_process import GRASP, PICK_AND_PLACE, contract_bytes

pytestmark = pytest.mark.slow
"""Three processes in real time, with limits of 50 ms: they need a machine that does nothing else."""

HERE = Path(__file__).parent
REST = ("hold", {"duration": 0.5})


@contextmanager
def gatekeeper(folder, **changes):
    plan = GatekeeperConfig(
        robot="panda",
        scene=open_scene("bare:0"),
        socket=str(folder / "s"),
        keys=str(folder / "keys"),
        report=str(folder / "robot.json"),
        **changes,
    )
    process = GatekeeperProcess(plan)
    try:
        yield process
    finally:
        process.stop()
        process.process.wait()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A running gatekeeper that the stories share; each leaves it as it found it: idle, drive on, nobody inside."""
    path = tmp_path_factory.mktemp("gatekeeper")
    with gatekeeper(path, capability=Capability(frozenset({"grasp", "place", "hold"}), {"grasp.speed": (0.0, 0.35)})):
        yield path


def link(folder, principal="planner", **options):
    keys = load_or_create_keys(folder / "keys")
    deadline = time.monotonic() + 3.0
    while True:  # the commander before may not be forgotten yet
        try:
            return GatekeeperClient(folder / "s", keys, principal, **options)
        except ConnectionLostError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


@pytest.fixture
def commander(folder):
    one = link(folder)
    yield one
    one.close()


@pytest.fixture
def operator(folder):
    one = link(folder, "operator")
    yield one
    one.close()


def until(watcher, true, timeout=5.0):
    """Seconds until a beat for which `true` holds."""
    start = time.monotonic()
    while not (watcher.beat and true(watcher.beat)):
        assert time.monotonic() - start < timeout, watcher.beat
        time.sleep(0.005)
    return time.monotonic() - start


def propose(link, data):
    return link.propose(data, link.look().scene.version)


def accepted(answer):
    return not isinstance(answer, RequestRefused) and answer.rejected is None


# --- contracts --------------------------------------------------------------------------------------------------


def test_a_contract_is_judged_by_all_stages_and_carried_out(commander):
    assert accepted(propose(commander, contract_bytes(REST)))
    ended = commander.ended(10.0)
    assert (ended.outcome.kind, ended.outcome.Delta) == ("succeeded", 0.0)


@pytest.mark.parametrize(
    ("data", "stage"),
    [
        (b"\xff not json", "syntax"),
        (contract_bytes(("home", {"speed": 0.1})), "authorization"),
        (contract_bytes(("grasp", {**GRASP, "speed": 0.39})), "envelope"),
        (contract_bytes(("grasp", {**GRASP, "object": "nothing"})), "envelope"),
        (
            contract_bytes(
                (
                    "place",
                    {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.1, "route": "direct", "wait": "none"},
                )
            ),
            "envelope",
        ),
    ],
    ids=["bytes", "not granted", "beyond the sub-envelope", "no such thing", "nothing held"],
)
def test_each_stage_refuses_in_the_gatekeeper(commander, data, stage):
    answer = propose(commander, data)
    assert isinstance(answer.rejected, Rejected)
    assert answer.rejected.stage == stage


def test_a_contract_for_another_scene_or_too_late_is_refused(commander):
    version = commander.look().scene.version
    assert commander.propose(contract_bytes(REST), version + 1).rejected.stage == "authorization"
    assert commander.propose(contract_bytes(REST), version, life=-1.0).rejected.stage == "authorization"


def test_what_was_sealed_once_is_worth_nothing_again(folder, commander):
    """The same bytes, sealed for an older connection, for another number, or by another hand: not even looked at."""
    keys = load_or_create_keys(folder / "keys")
    facts = {"issued": commander.now, "expires": commander.now + 9.0, "version": 1}
    body = contract_bytes(REST)
    for secret, nonce, shift in (
        (keys.secrets["planner"], b"0" * 16, 0),
        (keys.secrets["operator"], commander.nonce, 0),
    ):
        tag = contract_mac(secret, nonce, commander._sent + 1 + shift, body, **facts)
        commander.send(
            Propose(contract=body, issued=facts["issued"], expires=facts["expires"], scene_version=1, mac=tag)
        )
        with pytest.raises(ConnectionLostError, match="seal"):
            commander.wait_for_outcome(5.0)
        commander.close()
        commander = link(folder)
    commander.close()


def test_a_second_commander_is_refused_and_who_only_looks_may_not_propose(folder, commander, monkeypatch):
    keys = load_or_create_keys(folder / "keys")
    with pytest.raises(ConnectionLostError, match="commander already"):
        GatekeeperClient(folder / "s", keys, "planner")
    observer = GatekeeperClient(folder / "s")
    assert observer.welcome.role == "observer"
    refusal = observer.propose(contract_bytes(REST), 1)
    assert isinstance(refusal, RequestRefused)
    assert "commander" in refusal.reason
    observer.operate("resume")
    with pytest.raises(ConnectionLostError, match="operator's key"):
        observer.wait_for_outcome(2.0)
    observer.close()


# --- people's hands ---------------------------------------------------------------------------------------------


def test_anybody_may_press_the_emergency_stop_and_only_the_operator_leads_out(folder, commander, operator):
    assert accepted(propose(commander, contract_bytes(*PICK_AND_PLACE)))
    time.sleep(1.0)
    stranger = GatekeeperClient(folder / "s")
    stranger.operate("estop")
    assert until(commander, lambda beat: beat.action == "ESTOP") < 0.5
    ended = commander.ended(5.0).outcome
    assert ended.kind == "emergency", ended.reason
    for act in ("reset", "resume", "release_estop"):
        stranger.operate(act)
    time.sleep(0.3)
    assert commander.beat.action == "ESTOP"
    operator.operate("reset")
    time.sleep(0.2)
    assert commander.beat.action == "ESTOP", "the button is still pressed"
    operator.operate("release_estop")
    operator.operate("reset")
    until(commander, lambda beat: (beat.action, beat.check) == ("HOLD", "reset_held"))
    operator.operate("resume")
    until(commander, lambda beat: beat.action in ("NONE", "WARN"))
    stranger.close()


def test_pause_resume_and_abort(commander, operator):
    assert accepted(propose(commander, contract_bytes(("hold", {"duration": 1.0}))))
    operator.operate("pause")
    until(commander, lambda beat: beat.action == "HOVER")
    time.sleep(1.5)
    assert commander.beat.busy
    operator.operate("resume")
    assert commander.ended(5.0).outcome.kind == "paused"
    assert accepted(propose(commander, contract_bytes(("hold", {"duration": 9.0}))))
    operator.operate("abort")
    assert commander.ended(5.0).outcome.kind == "aborted"


# --- the cortex misbehaves --------------------------------------------------------------------------------------


@contextmanager
def cortex(folder, how):
    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), str(HERE / "cortex.py")]
    child = subprocess.Popen(
        [*command, str(folder / "s"), str(folder / "keys"), how],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout.readline() == "running\n"
        yield child
    finally:
        child.kill()
        child.wait()
        child.stdin.close()
        child.stdout.close()


@pytest.mark.parametrize(
    "how",
    ["kill", "flood", pytest.param("stop", marks=pytest.mark.slow), pytest.param("rubbish", marks=pytest.mark.slow)],
)
def test_whatever_the_cortex_does_the_arm_holds_and_the_next_one_is_welcome(folder, how):
    watcher = link(folder, "")
    with cortex(folder, how) as child:
        time.sleep(0.8)
        assert watcher.status.action in ("NONE", "WARN")
        if how in ("kill", "stop"):
            os.kill(child.pid, signal.SIGKILL if how == "kill" else signal.SIGSTOP)
        else:
            child.stdin.write("go\n")
            child.stdin.flush()
        took = until(watcher, lambda beat: beat.action == "HOLD")
        assert took < 1.0
        if how == "stop":
            assert watcher.status.check == "heartbeat_lost"
    until(watcher, lambda beat: not beat.busy)
    with_one = link(folder)
    until(watcher, lambda beat: beat.action in ("NONE", "WARN"))
    assert accepted(propose(with_one, contract_bytes(REST)))
    assert with_one.wait_for_outcome(10.0).outcome.kind == "succeeded"
    with_one.close()
    watcher.close()


def test_a_broken_frame_of_the_commander_is_the_end_of_its_command_only(folder, monkeypatch):
    monkeypatch.setattr(client_module, "HEARTBEAT_PERIOD", 9.0)
    one, watcher = link(folder), link(folder, "")
    one._socket.sendall(encode(kind_code(Heartbeat()), 99, encode_body(Heartbeat())))
    until(watcher, lambda beat: beat.check == "link_lost")
    one.close()
    watcher.close()


# --- the gatekeeper dies ----------------------------------------------------------------------------------------


def test_when_the_gatekeeper_is_killed_the_robots_own_watchdog_switches_it_off(tmp_path):
    with gatekeeper(tmp_path) as process:
        one = link(tmp_path)
        assert accepted(propose(one, contract_bytes(*PICK_AND_PLACE)))
        time.sleep(1.5)
        os.kill(process.process.pid, signal.SIGKILL)
        killed = time.monotonic()
        with pytest.raises(ConnectionLostError):
            one.wait_for_outcome(5.0)
        one.close()
        deadline = time.monotonic() + 10.0
        while not (tmp_path / "robot.json").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.1)
    report = msgspec.json.decode((tmp_path / "robot.json").read_bytes(), type=RobotReport)
    assert report.off_by == "watchdog"
    assert report.off_at - killed < WATCHDOG_TIMEOUT + 0.05
    assert report.off_at - report.silent_at < WATCHDOG_TIMEOUT + 0.05
    assert report.speed < 0.01
    assert report.travel < 0.2
    assert report.judgement.violations == ()
