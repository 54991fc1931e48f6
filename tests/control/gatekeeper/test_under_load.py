"""What holds in live processes however busy the machine is: conditions are waited for, no time is measured.

On a machine that has no time for them the processes may stop the arm by themselves, through the checks of timing or the
robot's own watchdog. Every promise here is one that holds then too.
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
from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.robot_link.simulated_robot import RobotReport
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.safety.integration.site import site_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from tests.stories.story_session import GRASP, PLACE, contract_text

PATIENCE = 300.0
"""No promise: only so that what never comes is a failure and not a hang [s]."""
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
RUN = "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(sys.argv[1:]))"
PICK = (("grasp", GRASP), ("place", PLACE))
FLAGS = ["-S"] if sys.flags.no_site else []


def until(what, true):
    """Wait for a condition; its first true value."""
    deadline = time.monotonic() + PATIENCE
    while not (value := true()):
        assert time.monotonic() < deadline, what
        time.sleep(0.01)
    return value


def link(socket, keys, principal):
    """A connection, as soon as the gatekeeper lets us in."""

    def tried():
        with suppress(ConnectionLostError):
            return GatekeeperClient(socket, load_or_create_keys(keys), principal)
        return None

    return until(f"{principal or 'an observer'} is let in", tried)


def at(watcher):
    """The rung that was told last."""
    return SafetyAction[watcher.beat.action] if watcher.beat else SafetyAction.NONE


def report_in(path):
    """The robot's report, once it is whole."""

    def read():
        with suppress(OSError, msgspec.DecodeError):
            return msgspec.json.decode(path.read_bytes(), type=RobotReport)
        return None

    return until("the robot leaves its report", read)


def harmless(report):
    """At rest, drive off, and nothing was touched that must not be."""
    assert report.off_at is not None
    assert report.speed < 0.05
    return [one for one in report.judgement.violations if one.kind != "object_dropped"] == []


def test_the_cortex_killed_leaves_a_held_arm_a_whole_ledger_and_a_gatekeeper_for_the_next(tmp_path: Path) -> None:
    (tmp_path / "pick.json").write_text(contract_text(*PICK))
    command = [
        sys.executable,
        *FLAGS,
        "-c",
        RUN,
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
    cortex = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        heard = ""
        for line in cortex.stderr:
            heard += line
            if "grasp: approach" in line:
                break
        else:
            pytest.fail(heard)
        socket, keys = (Path(line) for line in (tmp_path / "one" / "gatekeeper.address").read_text().split())
        watcher = link(socket, keys, "")
        cortex.send_signal(signal.SIGKILL)
        cortex.wait()
    finally:
        cortex.kill()
        cortex.stderr.close()
    until("the arm is held", lambda: at(watcher) >= SafetyAction.HOLD)
    until("its contract is over", lambda: not watcher.status.busy)
    commander = link(socket, keys, "planner")
    assert commander.welcome.role == "commander"
    operator = link(socket, keys, "operator")
    operator.operate("shut_down")
    assert harmless(report_in(tmp_path / "one" / "robot.json"))
    for one in (watcher, commander, operator):
        one.close()
    with LedgerReader(tmp_path / "ledger.sqlite") as ledger:
        assert ledger.verify().is_intact
        assert [event.kind for event in ledger.events()][-1] != "run_ended"
        assert list(ledger.events("kind = 'episode'")) == []


def test_a_site_an_emergency_stop_and_a_killed_gatekeeper(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(SITE)
    plan = GatekeeperConfig(
        robot="panda",
        scene=open_scene("bare:0"),
        socket=str(tmp_path / "s"),
        keys=str(tmp_path / "k"),
        report=str(tmp_path / "robot.json"),
        site=str(tmp_path / "lab.toml"),
    )
    registry = skill_registry(site_robot(load_robot("panda"), read_site(tmp_path / "lab.toml"))).hash
    process = GatekeeperProcess(plan)
    try:
        commander, operator = (link(tmp_path / "s", tmp_path / "k", who) for who in ("planner", "operator"))
        _site_holds(commander, registry)
        _stop_and_reset(tmp_path, operator)
        answer = _propose(commander, contract_text(*PICK, registry=registry))
        assert answer.rejected is None
        until("the contract runs", lambda: commander.status and commander.status.busy)
        os.kill(process.process.pid, signal.SIGKILL)
        until("the commander sees that the gatekeeper is gone", commander.disconnected.is_set)
        report = report_in(tmp_path / "robot.json")
    finally:
        process.stop()
        process.process.wait()
    for one in (commander, operator):
        one.close()
    assert harmless(report)
    assert report.off_by in ("watchdog", "order"), "an order, if the machine had no time for the arm before"


def _propose(commander, text):
    return commander.propose(text.encode(), commander.look().scene.version, life=PATIENCE)


def _site_holds(commander, registry):
    """What the site does not grant, and what was written for the wider body, is refused; where and why is told."""
    home = _propose(commander, contract_text(("home", {"speed": 0.1}), registry=registry)).rejected
    fast = _propose(commander, contract_text(("grasp", {**GRASP, "speed": 0.35}), registry=registry)).rejected
    wider = _propose(commander, contract_text(*PICK)).rejected
    assert (home.stage, fast.stage, wider.stage) == ("authorization", "envelope", "authorization")


def _stop_and_reset(folder, operator):
    stranger = GatekeeperClient(folder / "s")
    stranger.operate("estop")
    until("the arm is switched off", lambda: at(operator) >= SafetyAction.ESTOP)
    stranger.operate("release_estop")
    with pytest.raises(ConnectionLostError, match="operator's key"):
        stranger.wait_for_outcome(PATIENCE)
    stranger.close()
    assert at(operator) >= SafetyAction.ESTOP
    operator.operate("release_estop")

    def led_out():
        for act in ("reset", "resume"):
            operator.operate(act)
        time.sleep(0.2)
        return at(operator) < SafetyAction.HOLD

    until("release, reset and resume lead out", led_out)
