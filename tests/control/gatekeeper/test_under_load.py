"""Properties of the live processes that hold on a machine of any load: the tests poll for conditions.

On a machine under load, the processes may stop the arm by themselves, through the timing checks or the robot's own
watchdog. The properties that these tests check hold in that case, too.
"""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest

from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.robot_link.simulated_robot import RobotReport
from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.safety.integration.site import site_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from tests.stories.story_session import GRASP, PLACE, contract_text

pytestmark = pytest.mark.realtime
TIMEOUT = 300.0
"""Longest time [s] that a test waits for a condition, so that it fails instead of hanging."""
SITE = """
[robot]
tool_speed = 0.3
[[keep_out]]
name = "cabinet"
position = [0.2, 0.9, 0.4]
half_extents = [0.1, 0.1, 0.4]
[commander.planner]
skills = ["grasp", "place", "hold"]
"""
CLI_PROGRAM = "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(sys.argv[1:]))"
PICK = (("grasp", GRASP), ("place", PLACE))
FLAGS = ["-S"] if sys.flags.no_site else []


def wait_until(description, condition):
    """Poll a condition; returns its first true value."""
    deadline = time.monotonic() + TIMEOUT
    while not (value := condition()):
        assert time.monotonic() < deadline, description
        time.sleep(0.01)
    return value


def connect(socket, keys, principal):
    """A client, as soon as the gatekeeper accepts it."""

    def try_to_connect():
        with suppress(ConnectionLostError):
            return GatekeeperClient(socket, load_keys(keys, PRINCIPALS), principal)
        return None

    return wait_until(f"{principal or 'an observer'} is accepted", try_to_connect)


def reported_action(client):
    """The supervisor's action in the newest status report."""
    return SafetyAction[client.status.action] if client.status else SafetyAction.NONE


def wait_for_report(path):
    """The robot's report, once it is complete."""

    def read():
        with suppress(OSError, msgspec.DecodeError):
            return msgspec.json.decode(path.read_bytes(), type=RobotReport)
        return None

    return wait_until("the robot writes its report", read)


def is_harmless(report):
    """Whether the robot is at rest with the drive off, without any forbidden contact."""
    assert report.drive_off_at is not None
    assert report.speed < 0.05
    return [one for one in report.judgement.violations if one.kind != "object_dropped"] == []


def test_a_killed_run_leaves_a_braked_arm_an_intact_ledger_and_no_process(tmp_path: Path) -> None:
    (tmp_path / "pick.json").write_text(contract_text(*PICK))
    command = [
        sys.executable,
        *FLAGS,
        "-c",
        CLI_PROGRAM,
        "run",
        "put it there",
        "--contract",
        "pick.json",
        "--headless",
        "--live",
        "--scene",
        "bare:0",
        "--ledger",
        "ledger.sqlite",
        "--out",
        "one",
    ]
    environment = {**os.environ, "MUJOCO_GL": "disable", "COLUMNS": "500", "DUALBRAIN_HOME": str(tmp_path)}
    run = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        output = ""
        for line in run.stderr:
            output += line
            if "grasp: approach" in line:
                break
        else:
            pytest.fail(output)
        socket, keys = map(Path, (tmp_path / "one" / "gatekeeper.address").read_text().splitlines())
        observer = connect(socket, keys, "")
        wait_until("the gatekeeper reports its status", lambda: observer.status)
        run.send_signal(signal.SIGKILL)
        run.wait()
    finally:
        run.kill()
        run.stderr.close()
    wait_until("the gatekeeper has ended", observer.disconnected.is_set)
    observer.close()
    assert is_harmless(wait_for_report(tmp_path / "one" / "robot.json"))
    with pytest.raises(ConfigurationError, match="No gatekeeper listens"):
        GatekeeperClient(socket)
    with LedgerReader(tmp_path / "ledger.sqlite") as ledger:
        assert ledger.verify().is_intact
        assert [event.kind for event in ledger.events()][-1] != "run_ended"
        assert list(ledger.events("episode")) == []


def test_a_site_an_emergency_stop_and_a_killed_gatekeeper(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(SITE)
    config = GatekeeperConfig(
        robot="panda",
        scene=open_scene("bare:0"),
        socket=str(tmp_path / "s"),
        keys=str(tmp_path / "k"),
        report=str(tmp_path / "robot.json"),
        site=str(tmp_path / "lab.toml"),
    )
    registry = skill_registry(site_robot(load_robot("panda"), read_site(tmp_path / "lab.toml"))).hash
    process = GatekeeperProcess(config)
    try:
        commander, operator = (connect(tmp_path / "s", tmp_path / "k", who) for who in ("planner", "operator"))
        check_site_limits(commander, registry)
        stop_and_reset(tmp_path, operator)
        reply = propose(commander, contract_text(*PICK, registry=registry))
        assert reply.rejected is None
        wait_until("the contract runs", lambda: commander.status and commander.status.busy)
        os.kill(process.process.pid, signal.SIGKILL)
        wait_until("the commander detects the end of the gatekeeper", commander.disconnected.is_set)
        report = wait_for_report(tmp_path / "robot.json")
    finally:
        process.stop()
        process.process.wait()
    for one in (commander, operator):
        one.close()
    assert is_harmless(report)
    assert report.drive_off_cause in ("watchdog", "order"), "a decision of the supervisor, on a machine under load"


def propose(commander, text):
    return commander.propose(text.encode(), commander.request_scene().scene.version, lifetime=TIMEOUT)


def check_site_limits(commander, registry):
    """Contracts beyond the site's grants and limits, or for the robot without them, are rejected."""
    home = propose(commander, contract_text(("home", {"speed": 0.1}), registry=registry)).rejected
    fast = propose(commander, contract_text(("grasp", {**GRASP, "speed": 0.35}), registry=registry)).rejected
    wider = propose(commander, contract_text(*PICK)).rejected
    assert (home.stage, fast.stage, wider.stage) == ("authorization", "envelope", "authorization")


def stop_and_reset(folder, operator):
    """Any client may stop the arm; only the operator may release, reset and resume."""
    observer = GatekeeperClient(folder / "s")
    observer.operate("estop")
    wait_until("the arm is switched off", lambda: reported_action(operator) >= SafetyAction.ESTOP)
    observer.operate("release_estop")
    with pytest.raises(ConnectionLostError, match="operator's key"):
        observer.wait_for_outcome(TIMEOUT)
    observer.close()
    assert reported_action(operator) >= SafetyAction.ESTOP
    operator.operate("release_estop")

    def is_released():
        for act in ("reset", "resume"):
            operator.operate(act)
        time.sleep(0.2)
        return reported_action(operator) < SafetyAction.HOLD

    wait_until("release, reset and resume end the emergency stop", is_released)
