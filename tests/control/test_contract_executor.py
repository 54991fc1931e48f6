"""The control tick with a filter that says what the test wants: when a contract is given up, and in which state."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterStatus
from tests.grounding.perceived_scenes import bowl, box, scene

BODY = load_robot("panda")


class Still:
    """A robot that stands where it is told to stand, and a world in which only time passes."""

    def __init__(self):
        self.state, self.written, self.stopped = home_state(BODY), [], False

    def read(self):
        return self.state

    def write(self, command):
        self.written.append(command)

    def stop(self):
        self.stopped = True

    def look(self):
        return scene(box("red_cube", 0.5, -0.2), bowl())

    def advance(self):
        state = self.state
        self.state = replace(state, stamp=state.stamp + BODY.period, sequence=state.sequence + 1)


def layer(status=None, since=0.1, until=99.0, interrupted=lambda: False, guard=True):
    """A layer whose filter says `status` between two times [s]."""
    robot, safety = Still(), SafetyFilter(BODY)
    usual = safety.filter

    def said(state, u_nom, now):
        result = usual(state, u_nom, now)
        return msgspec.structs.replace(result, status=status) if status is not None and since <= now < until else result

    safety.filter = said
    log = FlightLog(Trace(BODY.n))
    config = ControlLoopConfig(guard=guard, settle_time=0.05)
    return robot, ContractExecutor(
        ControlLoop(BODY, robot, robot, safety, log, config, inputs=LoopInputs(interrupted=interrupted))
    )


def rest(seconds=1.0):
    return Contract("c-1", Context("panda", ""), (Action("hold", {"duration": seconds}),) * 2)


def test_a_good_filter_lets_the_contract_finish():
    robot, one = layer()
    outcome = one.execute(rest())
    assert (outcome.kind, outcome.Delta) == ("succeeded", 0.0)
    assert not robot.stopped
    assert outcome.duration == pytest.approx(2.0, abs=0.01)


def test_an_infeasible_filter_for_longer_than_50_ms_takes_over():
    robot, one = layer(FilterStatus.RELAXED)
    outcome = one.execute(rest())
    assert outcome.kind == "taken_over"
    assert "no safe control for 50 ms" in outcome.reason
    assert [action.status for action in outcome.actions] == ["taken_over", "not_run"]
    assert 0.14 < outcome.actions[0].ended < 0.16
    assert not robot.stopped


def test_an_infeasible_filter_for_less_than_50_ms_clears_by_itself():
    _, one = layer(FilterStatus.RELAXED, 0.1, 0.145)
    assert one.execute(rest()).kind == "succeeded"


@pytest.mark.parametrize("status", [FilterStatus.STOPPED, FilterStatus.FAULT])
def test_a_stopped_or_faulty_filter_stops_the_robot(status):
    robot, one = layer(status)
    outcome = one.execute(rest())
    assert outcome.kind == "stopped"
    assert status.name in outcome.reason
    assert robot.stopped


def test_an_interruption_stops_the_robot_after_braking():
    asked = []
    robot, one = layer(interrupted=lambda: bool(asked))
    usual = robot.advance

    def advance():
        usual()
        if robot.state.stamp > 0.2:
            asked.append(1)

    robot.advance = advance
    outcome = one.execute(rest())
    assert outcome.kind == "aborted"
    assert robot.stopped
    assert [action.status for action in outcome.actions] == ["stopped", "not_run"]
    assert np.allclose(robot.written[-1].u, 0.0)


def test_without_guard_the_nominal_is_written_as_it_is():
    robot, one = layer(guard=False)
    one.execute(rest(0.5))
    trace = one.log.trace
    assert np.array_equal(trace["u"], trace["u_nom"].astype(np.float32))
    assert not np.any(trace["delta"])
    assert len(robot.written) == len(trace)


def test_a_decline_moves_nothing():
    robot, one = layer()
    outcome = one.execute(Contract("c-1", Context("panda", ""), (Action("decline", {"reason": "no"}),)))
    assert (outcome.kind, outcome.Delta) == ("declined", None)
    assert all(np.allclose(command.u, 0.0) for command in robot.written)
