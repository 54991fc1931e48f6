"""A gatekeeper with a control thread: contracts, stops in both layers, and a loop that stalls."""

import os
import signal
import time

import msgspec
import numpy as np
import pytest

from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.deployment import Deployment
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.robot_link.simulated_robot import (
    WATCHDOG_TIMEOUT,
    RobotReport,
    SimulatedRobotSettings,
)
from dualbrain.control.gatekeeper.robot_link.threaded_robot import UNCOMPARED, ThreadedRobot, loop_timing
from dualbrain.control.gatekeeper.timing.tick_timing import TickTimingSummary
from dualbrain.control.recording.channels import ThreadTicks, read_recording
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.timing import FRANKA, SIMULATED
from dualbrain.simulation.scenes.generators.catalogue import open_scene

pytestmark = pytest.mark.realtime
TIMEOUT = 60.0
"""Longest time [s] that a test waits for a condition."""
LAG = 0.5
"""Time by which a loaded machine may delay the process of the robot [s]."""
FREE = ("NONE", "WARN", "SLOW")
"""Actions under which the arm may move; a loaded machine causes warnings."""
ABOVE_CUBE = {"target": "red_cube", "speed": 0.3, "clearance": 0.2, "route": "direct", "wait": "none"}


def contract(robot, *actions):
    registry = load_skill_registry(robot)
    sequence = [{"skill": skill, "params": params} for skill, params in actions]
    context = {"robot": registry.robot, "registry": registry.hash}
    return msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": sequence})


class Cell:
    """A gatekeeper process with a control thread, its operator and its commander."""

    def __init__(self, folder, robot="panda", **changes):
        self.folder, self.robot = folder, robot
        config = {"report": str(folder / "robot.json"), "tick_timing": str(folder / "timing.json")} | changes
        scene = open_scene("bare:0", robot)
        self.process = GatekeeperProcess(
            GatekeeperConfig(robot=robot, scene=scene, socket=str(folder / "s"), keys=str(folder / "keys"), **config)
        )
        keys = load_keys(folder / "keys", PRINCIPALS)
        self.operator = GatekeeperClient(folder / "s", keys, "operator")
        self.commander = GatekeeperClient(folder / "s", keys, "planner")

    def execute(self, *actions):
        """The outcome; a contract that this machine stops because it is too busy is tried again."""
        for _ in range(5):
            self.free()
            self.propose(*actions)
            outcome = self.commander.wait_for_outcome(TIMEOUT).outcome
            if outcome.kind not in ("stopped", "taken_over", "emergency"):
                break
        return outcome

    def free(self):
        """Wait until the arm may move; an emergency stop that this machine causes because it is too busy is reset."""
        deadline = time.monotonic() + TIMEOUT
        while not self.operator.status or self.operator.status.action not in (*FREE, "CONTROLLED_STOP"):
            assert time.monotonic() < deadline, self.operator.status
            for command in ("reset", "resume"):
                self.operator.operate(command)
                time.sleep(0.1)

    def propose(self, *actions):
        version = self.commander.request_scene().scene.version
        assert self.commander.propose(contract(self.robot, *actions), version).rejected is None

    def wait(self, description, condition):
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, description
            time.sleep(0.01)

    def wait_for_action(self, *actions):
        self.wait(actions, lambda: self.operator.status and self.operator.status.action in actions)

    def begin_motion(self, *actions):
        """Propose a contract, and return while the arm moves; one that ends before is proposed again."""
        for _ in range(5):
            self.free()
            start = self.operator.request_scene().q
            self.propose(*actions)
            while self.runs():
                if self.has_moved(start):
                    return
            outcome = self.commander.wait_for_outcome(TIMEOUT).outcome
            assert not self.has_moved(start), f"the motion ended unseen: {outcome}"
        raise AssertionError(f"no contract moved the arm: {outcome}")

    def runs(self):
        """Whether the contract runs, by a status that is sent after the call."""
        known = self.operator.status
        self.wait("a new status", lambda: self.operator.status is not known)
        return self.operator.status.busy

    def has_moved(self, start):
        return np.abs(np.subtract(self.operator.request_scene().q, start)).max() > 0.05

    def close(self):
        self.operator.close()
        self.commander.close()
        self.process.stop()

    @property
    def timing(self):
        return msgspec.json.decode((self.folder / "timing.json").read_bytes(), type=TickTimingSummary)

    @property
    def report(self):
        return msgspec.json.decode((self.folder / "robot.json").read_bytes(), type=RobotReport)


@pytest.fixture
def cell(tmp_path):
    made = Cell(tmp_path, control_thread=True, recording=str(tmp_path / "ticks.mcap"))
    yield made
    made.close()


def test_contracts_run_and_an_emergency_stop_reaches_both_layers_and_is_cleared(cell):
    assert cell.execute(("move_to", ABOVE_CUBE)).kind == "succeeded"
    cell.begin_motion(("home", {"speed": 0.2}))
    cell.operator.operate("estop")
    cell.wait_for_action("ESTOP")
    assert cell.commander.wait_for_outcome(TIMEOUT).outcome.kind in ("emergency", "stopped")
    for command, actions in (("release_estop", ("ESTOP",)), ("reset", ("HOLD",)), ("resume", FREE)):
        cell.operator.operate(command)
        cell.wait_for_action(*actions)
    assert cell.execute(("home", {"speed": 0.3})).kind == "succeeded"
    cell.close()
    thread = cell.timing.control_thread
    assert (thread.malformed, thread.log_dropped, thread.refused) == (0, 0, 0)
    assert not cell.report.judgement.violations
    ticks = [one.columns for one in read_recording(cell.folder / "ticks.mcap") if isinstance(one, ThreadTicks)]
    numbers = [number for columns in ticks for number in columns["tick"]]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    u = np.concatenate([columns["u"] for columns in ticks])
    assert u.shape == (len(numbers), 7)
    assert np.abs(u).max() > 0.05
    assert {0, 1} <= {int(one) for columns in ticks for one in columns["drive"]}


def test_a_killed_gatekeeper_leaves_the_arm_at_rest_within_the_time_of_the_watchdog(cell):
    cell.begin_motion(("move_to", ABOVE_CUBE))
    os.kill(cell.process.process.pid, signal.SIGKILL)
    cell.process.process.wait()
    cell.wait("a report", (cell.folder / "robot.json").exists)
    report = cell.report
    assert report.drive_off_at - report.last_command_at <= WATCHDOG_TIMEOUT + LAG
    assert report.speed < 1e-3
    assert not report.judgement.violations


@pytest.mark.parametrize(("driver", "robot"), [("fake_franka", "fr3"), ("fake_ur", "ur5e")])
def test_a_driver_moves_its_arm_by_the_commands_of_the_thread(tmp_path, driver, robot):
    realtime = "ignore" if driver == "fake_franka" else "enforce"
    made = Cell(tmp_path, robot, driver=driver, address="fake", realtime=realtime, report="")
    try:
        made.free()
        start = made.operator.request_scene().q
        assert made.execute(("move_to", ABOVE_CUBE)).kind == "succeeded"
        assert np.abs(np.subtract(made.operator.request_scene().q, start)).max() > 0.1
    finally:
        made.close()
    assert made.timing.control_thread.malformed == 0


def test_a_mobile_base_is_refused_with_the_remedy():
    config = GatekeeperConfig(robot="base", scene=open_scene("0", "base"), socket="s", keys="k", control_thread=True)
    with pytest.raises(ConfigurationError, match="--control-thread"):
        Deployment.from_config(config)


# --- the loop above the thread, in this process ----------------------------------------------------------------------


RESET_STEPS = {600: int(Condition.RESET), 799: int(Condition.RESUME | Condition.CONTINUE)}
"""Buttons that end a stop, by the number of the tick."""
FAULTS_OF_THE_ARM = {"tracking_off", "tracking_lost", "sources_disagree", "overspeed", "drift", "state_implausible"}


class Loop:
    """A control loop in lockstep with the states, which a test can stall."""

    def __init__(self):
        model = load_robot("panda")
        settings = SimulatedRobotSettings(robot="panda", scene=open_scene("bare:0"))
        self.robot = ThreadedRobot(settings, SIMULATED)
        self.safety = self.robot.make_filter(model, None, ())
        self.controller = SafetyController(self.safety, timing=self.robot.loop_timing, monitor_limits=UNCOMPARED)
        self.checks, self.continued, self.executed = set(), 0, []
        self.robot.skip_to_newest_state()
        self.state = self.robot.read()

    def tick(self, u_nom, conditions=0):
        now = self.robot.clock()
        self.checks.add(self.controller.decide(self.state, now, conditions | self.robot.conditions()).check)
        self.continued += self.controller.continue_desired_motion(self.state) is not None
        result = self.controller.control(self.state, np.array([u_nom, *np.zeros(6)]), now)
        if self.controller.drive_wanted:
            self.robot.write(Command(result.u, 0.04, 0.0))
        self.advance()

    def advance(self):
        self.robot.advance()
        self.state = self.robot.read()
        self.controller.accept_state(self.state, self.robot.clock())
        record = self.robot._record
        if record is not None and not record["external"] and record["action"] < SafetyAction.SLOW:
            self.executed.append(self.state.desired_v is None)

    def run(self, seconds, u_nom):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.tick(u_nom)

    def move(self, speed=0.1):
        """Run until the first joint has this speed; a stop that this machine causes because it is too busy is ended.

        Returns the control of the joint.
        """
        deadline, ticks, u_nom = time.monotonic() + TIMEOUT, 0, -speed if self.state.q[0] > 0.0 else speed
        while self.state.v[0] * np.sign(u_nom) < 0.9 * speed:
            assert time.monotonic() < deadline, f"no motion: {self.controller.decision}"
            ticks += 1
            stopped = self.controller.decision.action >= SafetyAction.CONTROLLED_STOP
            self.tick(u_nom, RESET_STEPS.get(ticks % 800, 0) if stopped or ticks % 800 == 799 else 0)
        return u_nom


@pytest.fixture
def loop():
    made = Loop()
    yield made
    made.robot.close()


def test_while_the_loop_stalls_the_thread_holds_the_arm_and_the_loop_continues_afterwards(loop):
    loop.move()
    loop.robot.notes()
    time.sleep(0.4)  # no control arrives
    loop.advance()
    assert loop.robot._record["action"] >= SafetyAction.HOLD
    assert np.abs(loop.state.v).max() < 0.01
    loop.continued = 0
    loop.move()
    loop.run(0.3, 0.0)
    assert loop.continued > 0
    notes = loop.robot.notes()
    assert notes.index("the controls are late: the arm holds") < notes.index("the controls are in time again")
    assert not loop.checks & FAULTS_OF_THE_ARM


def test_the_thread_executes_the_controls_of_a_loop_that_is_in_time(loop):
    u_nom = loop.move()
    loop.executed.clear()
    loop.run(0.5, u_nom)
    assert len(loop.executed) > 20
    assert np.mean(loop.executed) > 0.9


@pytest.mark.parametrize("seconds", [0.06, 0.1, 0.13, 0.2, 0.3])
def test_a_stall_of_any_length_below_the_limit_is_no_fault_of_the_arm(loop, seconds):
    u_nom = loop.move(0.8)
    time.sleep(seconds)
    loop.run(0.2, u_nom)
    assert not loop.checks & FAULTS_OF_THE_ARM


def test_a_loop_that_hangs_ends_with_the_drive_off_and_continues_with_the_next_contract(loop):
    loop.move()
    time.sleep(1.2)
    loop.advance()
    assert not loop.state.drive_enabled
    loop.run(0.8, 0.0)
    assert loop.controller.decision.action >= SafetyAction.CONTROLLED_STOP
    assert "tick_lost" in loop.checks
    loop.move()


def test_a_condition_that_only_the_thread_detects_reaches_the_loop(loop, monkeypatch):
    loop.run(0.2, 0.0)
    monkeypatch.setattr(loop.robot._thread, "take_conditions", lambda: int(Condition.OVERSPEED))
    loop.tick(0.0)
    assert loop.controller.decision.check == "overspeed"


def test_a_stop_that_only_the_thread_has_decided_stops_the_loop_too(loop):
    loop.run(0.2, 0.0)
    record = loop.robot._record.copy()
    names = [one.name for one in CHECKS]
    record["action"], record["check"] = SafetyAction.CONTROLLED_STOP, names.index("tick_lost")
    loop.robot._record = record
    loop.controller.decide(loop.state, loop.robot.clock())
    assert loop.controller.decision.check == "tick_lost"
    loop.safety.stopped = True
    assert not loop.robot._thread_conditions() & int(Condition.TICK_LOST)


def test_the_loop_may_be_late_by_the_validity_of_a_control_and_the_thread_keeps_the_limits_of_the_driver():
    limits = loop_timing(FRANKA, 0.05)
    assert (limits.command_deadline, limits.max_tick_time, limits.state_stale_after) == (0.05, 0.05, 0.05)
    assert (limits.period, limits.drive_on_silence) == (FRANKA.period, FRANKA.drive_on_silence)
    assert limits.tick_lost_after > 0.05
