"""Gatekeeper, robot and commander as processes: contracts, operator commands, and commanders that fail."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol import client as client_module
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, contract_mac, load_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Heartbeat, Propose, RequestRefused, encode_body, kind_code
from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG_TIMEOUT, RobotReport
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.gatekeeper.commander_messages import GRASP, PICK_AND_PLACE, contract_bytes

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
"""Three processes in real time, with limits of 50 ms: these tests need a machine without other load."""

FOLDER = Path(__file__).parent
HOLD = ("hold", {"duration": 0.5})
TIMEOUT = 5.0
"""Longest time [s] that a test waits for a condition."""


@contextmanager
def gatekeeper(folder, **changes):
    config = GatekeeperConfig(
        robot="panda",
        scene=open_scene("bare:0"),
        socket=str(folder / "s"),
        keys=str(folder / "keys"),
        report=str(folder / "robot.json"),
        **changes,
    )
    process = GatekeeperProcess(config)
    try:
        yield process
    finally:
        process.stop()
        process.process.wait()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A running gatekeeper that the tests share; each test leaves it idle, with the drive on and no commander."""
    path = tmp_path_factory.mktemp("gatekeeper")
    with gatekeeper(path, capability=Capability(frozenset({"grasp", "place", "hold"}), {"grasp.speed": (0.0, 0.35)})):
        yield path


def connect(folder, principal="planner", **options):
    """A client, as soon as the gatekeeper accepts it: the last commander may still be connected."""
    keys = load_keys(folder / "keys", PRINCIPALS)
    deadline = time.monotonic() + 3.0
    while True:
        try:
            return GatekeeperClient(folder / "s", keys, principal, **options)
        except ConnectionLostError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


@pytest.fixture
def commander(folder):
    client = connect(folder)
    yield client
    client.close()


@pytest.fixture
def operator(folder):
    client = connect(folder, "operator")
    yield client
    client.close()


def wait_until(condition, timeout=TIMEOUT):
    """Poll until `condition()` holds; returns the waiting time [s]."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < timeout
        time.sleep(0.005)
    return time.monotonic() - start


def wait_for_status(client, condition):
    """Poll until the newest status report meets the condition; returns the waiting time [s]."""
    return wait_until(lambda: client.status and condition(client.status))


def wait_robot_time(client, seconds):
    """Wait until the robot's time has advanced by `seconds`, after everything that `client` sent was received."""
    start = client.request_scene().now
    wait_for_status(client, lambda status: status.now > start + seconds)


def wait_for_motion(client):
    """Wait until the robot of `client` has moved by 0.05 rad."""
    start = client.request_scene().q
    wait_until(lambda: max(abs(np.subtract(client.request_scene().q, start))) > 0.05)


def propose(client, data):
    return client.propose(data, client.request_scene().scene.version)


def is_accepted(reply):
    return not isinstance(reply, RequestRefused) and reply.rejected is None


# --- contracts --------------------------------------------------------------------------------------------------


def test_a_contract_is_checked_by_all_stages_and_executed(commander):
    assert is_accepted(propose(commander, contract_bytes(HOLD)))
    ended = commander.wait_for_outcome(10.0)
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
    ids=["bytes", "not granted", "beyond the granted bounds", "unknown object", "nothing held"],
)
def test_each_stage_of_the_gate_rejects_in_the_gatekeeper(commander, data, stage):
    reply = propose(commander, data)
    assert isinstance(reply.rejected, Rejected)
    assert reply.rejected.stage == stage


def test_a_contract_for_another_scene_or_after_its_expiry_is_rejected(commander):
    version = commander.request_scene().scene.version
    assert commander.propose(contract_bytes(HOLD), version + 1).rejected.stage == "authorization"
    assert commander.propose(contract_bytes(HOLD), version, lifetime=-1.0).rejected.stage == "authorization"


def test_an_authentication_code_is_valid_for_one_connection_and_one_principal(folder, commander):
    """A contract with a code for another connection, or of another principal, is not passed to the gate."""
    keys = load_keys(folder / "keys", PRINCIPALS)
    facts = {"issued": commander.now, "expires": commander.now + 9.0, "scene_version": 1}
    body = contract_bytes(HOLD)
    for secret, nonce in ((keys.secrets["planner"], b"0" * 16), (keys.secrets["operator"], commander.nonce)):
        mac = contract_mac(secret, nonce, commander._sent + 1, body, **facts)
        commander.send(Propose(contract=body, mac=mac, **facts))
        with pytest.raises(ConnectionLostError, match="authentication code"):
            commander.wait_for_outcome(5.0)
        commander.close()
        commander = connect(folder)
    commander.close()


def test_a_second_commander_is_refused_and_an_observer_may_not_propose(folder, commander):
    keys = load_keys(folder / "keys", PRINCIPALS)
    with pytest.raises(ConnectionLostError, match="commander already"):
        GatekeeperClient(folder / "s", keys, "planner")
    observer = GatekeeperClient(folder / "s")
    assert observer.welcome.role == "observer"
    refusal = observer.propose(contract_bytes(HOLD), 1)
    assert isinstance(refusal, RequestRefused)
    assert "commander" in refusal.reason
    observer.operate("resume")
    with pytest.raises(ConnectionLostError, match="operator's key"):
        observer.wait_for_outcome(2.0)
    observer.close()


# --- operator commands ------------------------------------------------------------------------------------------


def test_every_client_may_press_the_emergency_stop_and_only_the_operator_may_reset_it(folder, commander, operator):
    assert is_accepted(propose(commander, contract_bytes(*PICK_AND_PLACE)))
    wait_for_motion(commander)
    observer = GatekeeperClient(folder / "s")
    observer.operate("estop")
    assert wait_for_status(commander, lambda status: status.action == "ESTOP") < 0.5
    ended = commander.wait_for_outcome(5.0).outcome
    assert ended.kind == "emergency", ended.reason
    for act in ("reset", "resume", "release_estop"):
        observer.operate(act)
    wait_robot_time(observer, 0.3)
    assert observer.status.action == "ESTOP"
    operator.operate("reset")
    wait_robot_time(operator, 0.2)
    assert operator.status.action == "ESTOP", "the button is still pressed"
    operator.operate("release_estop")
    operator.operate("reset")
    wait_for_status(commander, lambda status: (status.action, status.check) == ("HOLD", "reset_held"))
    operator.operate("resume")
    wait_for_status(commander, lambda status: status.action in ("NONE", "WARN"))
    observer.close()


def test_pause_resume_and_abort(commander, operator):
    assert is_accepted(propose(commander, contract_bytes(("hold", {"duration": 1.0}))))
    operator.operate("pause")
    wait_for_status(commander, lambda status: status.action == "HOVER")
    wait_robot_time(commander, 1.5)
    assert commander.status.busy
    operator.operate("resume")
    assert commander.wait_for_outcome(5.0).outcome.kind == "paused"
    assert is_accepted(propose(commander, contract_bytes(("hold", {"duration": 9.0}))))
    operator.operate("abort")
    assert commander.wait_for_outcome(5.0).outcome.kind == "aborted"


# --- the commander fails ----------------------------------------------------------------------------------------


@contextmanager
def commander_process(folder, failure):
    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), str(FOLDER / "commander_process.py")]
    child = subprocess.Popen(
        [*command, str(folder / "s"), str(folder / "keys"), failure],
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


@pytest.mark.parametrize("failure", ["kill", "flood", "stop", "malformed"])
def test_after_any_failure_of_the_commander_the_arm_holds_and_another_one_is_accepted(folder, failure):
    observer = connect(folder, "")
    with commander_process(folder, failure) as child:
        wait_for_motion(observer)
        assert observer.status.action in ("NONE", "WARN")
        if failure in ("kill", "stop"):
            os.kill(child.pid, signal.SIGKILL if failure == "kill" else signal.SIGSTOP)
        else:
            child.stdin.write("go\n")
            child.stdin.flush()
        assert wait_for_status(observer, lambda status: status.action == "HOLD") < 1.0
        if failure == "stop":
            assert observer.status.check == "heartbeat_lost"
    wait_for_status(observer, lambda status: not status.busy)
    commander = connect(folder)
    wait_for_status(observer, lambda status: status.action in ("NONE", "WARN"))
    assert is_accepted(propose(commander, contract_bytes(HOLD)))
    assert commander.wait_for_outcome(10.0).outcome.kind == "succeeded"
    commander.close()
    observer.close()


def test_a_malformed_frame_ends_only_the_connection_of_the_commander(folder, monkeypatch):
    monkeypatch.setattr(client_module, "HEARTBEAT_PERIOD", 9.0)
    commander, observer = connect(folder), connect(folder, "")
    commander._socket.sendall(encode(kind_code(Heartbeat()), 99, encode_body(Heartbeat())))
    wait_for_status(observer, lambda status: status.check == "link_lost")
    commander.close()
    observer.close()


# --- the gatekeeper dies ----------------------------------------------------------------------------------------


def read_report(path):
    """The robot's report, None while it is not complete."""
    with suppress(OSError, msgspec.DecodeError):
        return msgspec.json.decode(path.read_bytes(), type=RobotReport)
    return None


def test_the_watchdog_of_the_robot_switches_it_off_when_the_gatekeeper_is_killed(tmp_path):
    with gatekeeper(tmp_path) as process:
        commander = connect(tmp_path)
        assert is_accepted(propose(commander, contract_bytes(*PICK_AND_PLACE)))
        wait_for_motion(commander)
        os.kill(process.process.pid, signal.SIGKILL)
        killed = time.monotonic()
        with pytest.raises(ConnectionLostError):
            commander.wait_for_outcome(5.0)
        commander.close()
        wait_until(lambda: read_report(tmp_path / "robot.json"), 10.0)
    report = read_report(tmp_path / "robot.json")
    assert report.drive_off_cause == "watchdog"
    assert report.drive_off_at - killed < WATCHDOG_TIMEOUT + 0.05
    assert report.drive_off_at - report.last_command_at < WATCHDOG_TIMEOUT + 0.05
    assert report.speed < 0.01
    assert report.travel < 0.2
    assert report.judgement.violations == ()
