"""The contract executor with a filter of a given status: when a contract ends, and in which state of the robot."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.records import FailureCause, ObjectLimits
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.skills.arm.load_monitor import LoadEvent
from tests.grounding.perceived_scenes import bowl, box, scene

MODEL = load_robot("panda")


class RobotAtRest:
    """A robot that does not move, in a world in which only time passes."""

    def __init__(self):
        self.state, self.written, self.stopped = home_state(MODEL), [], False

    def read(self):
        return self.state

    def write(self, command):
        self.written.append(command)

    def stop(self):
        self.stopped = True

    def perceive(self):
        return scene(box("red_cube", 0.5, -0.2), bowl())

    def advance(self):
        state = self.state
        self.state = replace(state, stamp=state.stamp + MODEL.period, sequence=state.sequence + 1)


def make_executor(status=None, since=0.1, until=99.0, interrupted=lambda: False, guard=True, settle_time=0.05):
    """A robot and an executor whose filter has the `status` between two times [s]."""
    robot, safety = RobotAtRest(), SafetyFilter(MODEL)
    filter_control = safety.filter

    def filter_with_status(state, u_nom, now):
        result = filter_control(state, u_nom, now)
        return msgspec.structs.replace(result, status=status) if status is not None and since <= now < until else result

    safety.filter = filter_with_status
    log = FlightLog(Trace(MODEL.n))
    config = ControlLoopConfig(guard=guard, settle_time=settle_time)
    return robot, ContractExecutor(
        ControlLoop(MODEL, robot, robot, safety, log, config, inputs=LoopInputs(interrupted=interrupted))
    )


def hold_contract(seconds=1.0):
    return Contract("c-1", Context("panda", ""), (Action("hold", {"duration": seconds}),) * 2)


def test_a_good_filter_lets_the_contract_finish():
    robot, executor = make_executor()
    outcome = executor.execute(hold_contract())
    assert (outcome.kind, outcome.Delta) == ("succeeded", 0.0)
    assert not robot.stopped
    assert outcome.duration == pytest.approx(2.0, abs=0.01)


def test_an_infeasible_filter_for_longer_than_50_ms_takes_over():
    robot, executor = make_executor(FilterStatus.RELAXED)
    outcome = executor.execute(hold_contract())
    assert outcome.kind == "taken_over"
    assert "no safe control for 50 ms" in outcome.reason
    assert [action.status for action in outcome.actions] == ["taken_over", "not_run"]
    assert 0.14 < outcome.actions[0].ended < 0.16
    assert not robot.stopped


def test_an_infeasible_filter_for_less_than_50_ms_clears_by_itself():
    _, executor = make_executor(FilterStatus.RELAXED, 0.1, 0.145)
    assert executor.execute(hold_contract()).kind == "succeeded"


@pytest.mark.parametrize("status", [FilterStatus.STOPPED, FilterStatus.FAULT])
def test_a_stopped_or_faulty_filter_stops_the_robot(status):
    robot, executor = make_executor(status)
    outcome = executor.execute(hold_contract())
    assert outcome.kind == "stopped"
    assert status.name in outcome.reason
    assert robot.stopped


@pytest.mark.parametrize(
    ("status", "kind"),
    [(FilterStatus.STOPPED, "stopped"), (FilterStatus.FAULT, "stopped"), (FilterStatus.RELAXED, "taken_over")],
)
def test_a_filter_that_stops_while_the_robot_settles_ends_the_contract(status, kind):
    robot, executor = make_executor(status, since=1.02, settle_time=0.3)
    outcome = executor.execute(hold_contract(0.5))
    assert outcome.kind == kind
    assert "50 ms" in outcome.reason
    assert [action.status for action in outcome.actions] == ["done", "done"]
    assert robot.stopped == (kind == "stopped")


def test_an_interruption_while_the_robot_settles_aborts_the_contract():
    robot, executor = make_executor(interrupted=lambda: robot.state.stamp > 1.1, settle_time=0.3)
    outcome = executor.execute(hold_contract(0.5))
    assert (outcome.kind, robot.stopped) == ("aborted", True)


@pytest.mark.parametrize(("slip", "cause"), [(0.0, FailureCause.LOAD_LOST), (0.02, FailureCause.LOAD_SLIPPED)])
def test_a_change_of_the_load_while_the_robot_settles_is_a_failure_of_the_last_action(slip, cause):
    robot, executor = make_executor(settle_time=0.3)
    advance_time, event = robot.advance, LoadEvent("red_cube", slip)

    def advance():
        advance_time()
        if robot.state.stamp > 1.1:
            executor.loop.controller.load_event = event

    robot.advance = advance
    outcome = executor.execute(hold_contract(0.5))
    assert (outcome.kind, outcome.failure_cause) == ("failed", cause)
    assert [action.status for action in outcome.actions] == ["done", "failed"]
    assert outcome.reason == f"settle: {event.describe()}"


def test_an_interruption_stops_the_robot_after_braking():
    interruptions = []
    robot, executor = make_executor(interrupted=lambda: bool(interruptions))
    advance_time = robot.advance

    def advance():
        advance_time()
        if robot.state.stamp > 0.2:
            interruptions.append(1)

    robot.advance = advance
    outcome = executor.execute(hold_contract())
    assert outcome.kind == "aborted"
    assert robot.stopped
    assert [action.status for action in outcome.actions] == ["stopped", "not_run"]
    assert np.allclose(robot.written[-1].u, 0.0)


def test_without_the_filter_the_nominal_control_is_written_unchanged():
    robot, executor = make_executor(guard=False)
    executor.execute(hold_contract(0.5))
    trace = executor.log.trace
    assert np.array_equal(trace["u"], trace["u_nom"].astype(np.float32))
    assert not np.any(trace["delta"])
    assert len(robot.written) == len(trace)


def test_every_contract_at_a_lower_speed_stage_is_slowed_until_the_stage_ends():
    _, executor = make_executor()
    executor.loop.safety_controller.speed_scale = 0.5
    executor.hold(0.1)
    assert [executor.execute(hold_contract(0.5)).kind for _ in range(2)] == ["slowed", "slowed"]
    executor.loop.safety_controller.speed_scale = 1.0
    assert executor.execute(hold_contract(0.5)).kind == "succeeded"


def test_a_speed_stage_counts_beside_a_stronger_check():
    _, executor = make_executor()
    executor.loop.inputs = LoopInputs(external_conditions=lambda: int(Condition.TICKS_OVERRUN))
    executor.loop.safety_controller.speed_scale = 0.5
    assert executor.execute(hold_contract(0.5)).kind == "slowed"
    assert executor.loop.safety_controller.decision.check == "ticks_overrun"


def test_a_decline_moves_nothing():
    robot, executor = make_executor()
    outcome = executor.execute(Contract("c-1", Context("panda", ""), (Action("decline", {"reason": "no"}),)))
    assert (outcome.kind, outcome.Delta) == ("declined", None)
    assert all(np.allclose(command.u, 0.0) for command in robot.written)


def test_the_first_scene_has_the_limits_of_the_site_also_if_later_ones_are_refused():
    class BlindedAfterOnce(RobotAtRest):
        scenes = 0

        def perceive(self):
            self.scenes += 1
            return scene(box("red_cube", 0.5 if self.scenes == 1 else np.nan, -0.2), bowl())

    robot, limits = BlindedAfterOnce(), ObjectLimits(force=8.0)
    config = ControlLoopConfig(object_limits={"red_cube": limits})
    loop = ControlLoop(MODEL, robot, robot, SafetyFilter(MODEL), FlightLog(Trace(MODEL.n)), config)
    assert robot.scenes > 1
    assert loop.scene.find("red_cube").limits == limits
