"""Rows that no table holds (handed in, or asked for by live barriers) are recorded, and a replay reaches the same."""

from dataclasses import replace

import numpy as np

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig
from dualbrain.control.recording import replay as replay_module
from dualbrain.control.recording.channels import FilterCall, read_recording
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.barriers.singularity import SingularityBarrier
from dualbrain.safety.cbf.filter import ConstraintRow, SafetyFilter
from tests.grounding.perceived_scenes import scene

BODY = load_robot("panda")


class Follower:
    """A robot that does what it is told, in an empty room."""

    def __init__(self):
        self.state, self.u = home_state(BODY), np.zeros(BODY.n)

    def read(self):
        return self.state

    def write(self, command):
        self.u = np.array(command.u)

    def stop(self):
        self.u = np.zeros(BODY.n)

    def look(self):
        return scene()

    def advance(self):
        last = self.state
        self.state = replace(
            last, stamp=last.stamp + BODY.period, sequence=last.sequence + 1, q=last.q + BODY.period * self.u, v=self.u
        )


class Sway:
    """The first joint must turn on, at a pace that changes with the posture and the hour."""

    def rows(self, state, jacobian):
        pace = 0.02 + 0.02 * np.sin(20.0 * state.stamp) + 0.1 * float(jacobian[0, 0])
        return (ConstraintRow("sway", (1.0, *(0.0,) * (BODY.n - 1)), pace),)


def recorded(folder, barriers, rows):
    """A short rest under a filter with live barriers and rows of its own; the recording."""
    path, robot, trace = folder / "episode.mcap", Follower(), Trace(BODY.n)
    safety = SafetyFilter(BODY, barriers=barriers)
    safety.constrain(rows)
    with Recorder(path, trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True, "instruction": ""})
        layer = ContractExecutor(
            ControlLoop(BODY, robot, robot, safety, FlightLog(trace, recorder), ControlLoopConfig(settle_time=0.05))
        )
        layer.execute(Contract("c-1", Context("panda", ""), (Action("hold", {"duration": 0.3}),)))
    return path, trace


def without_rows(monkeypatch, path):
    """The replay of the recording had rows not been recorded."""
    kept = [m for m in read_recording(path) if not (isinstance(m, FilterCall) and m.name == "constrain")]
    monkeypatch.setattr(replay_module, "read_recording", lambda _: iter(kept))
    return replay(path)


def test_rows_of_live_barriers_and_rows_handed_in_are_reached_again(tmp_path, monkeypatch):
    second = ConstraintRow("user_rows: second", (0.0, 1.0, *(0.0,) * (BODY.n - 2)), 0.01)
    path, trace = recorded(tmp_path, (Sway(), SingularityBarrier(BODY.alpha)), [second])
    assert np.all(trace["u"][1:, 1] > 0.009), "the row handed in is met"
    assert np.ptp(trace["u"][50:, 0]) > 0.01, "and the live one, which changes"
    result = replay(path)
    assert result.ticks == len(trace) > 250
    assert (result.identical, result.worst) == (True, {})
    assert not without_rows(monkeypatch, path).identical


def test_rows_that_stay_are_recorded_once(tmp_path):
    first = ConstraintRow("user_rows: first", (1.0, *(0.0,) * (BODY.n - 1)), 0.01)
    path, _ = recorded(tmp_path, (), [first])
    calls = [m for m in read_recording(path) if isinstance(m, FilterCall) and m.name == "constrain"]
    assert len(calls) == 1
    assert replay(path).identical
