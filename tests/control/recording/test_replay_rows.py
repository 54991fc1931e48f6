"""Additional rows (of the user, or of live barriers) are record, and a replay recomputes the same controls."""

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

MODEL = load_robot("panda")


class Follower:
    """A robot that follows its commands exactly, in an empty room."""

    def __init__(self):
        self.state, self.u = home_state(MODEL), np.zeros(MODEL.n)

    def read(self):
        return self.state

    def write(self, command):
        self.u = np.array(command.u)

    def stop(self):
        self.u = np.zeros(MODEL.n)

    def perceive(self):
        return scene()

    def advance(self):
        last = self.state
        self.state = replace(
            last,
            stamp=last.stamp + MODEL.period,
            sequence=last.sequence + 1,
            q=last.q + MODEL.period * self.u,
            v=self.u,
        )


class SwayBarrier:
    """The first joint must turn, at a speed that changes with posture and time."""

    def rows(self, state, jacobian):
        speed = 0.02 + 0.02 * np.sin(20.0 * state.stamp) + 0.1 * float(jacobian[0, 0])
        return (ConstraintRow(name="sway", a=(1.0, *(0.0,) * (MODEL.n - 1)), b=speed),)


def record(folder, barriers, rows):
    """The recording and trace of a short hold, under a filter with live barriers and additional rows."""
    path, robot, trace = folder / "episode.mcap", Follower(), Trace(MODEL.n)
    safety = SafetyFilter(MODEL, barriers=barriers)
    safety.constrain(rows)
    with Recorder(path, trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True, "instruction": ""})
        executor = ContractExecutor(
            ControlLoop(MODEL, robot, robot, safety, FlightLog(trace, recorder), ControlLoopConfig(settle_time=0.05))
        )
        executor.execute(Contract("c-1", Context("panda", ""), (Action("hold", {"duration": 0.3}),)))
    return path, trace


def replay_without_rows(monkeypatch, path):
    """The replay of the recording without its recorded rows."""
    messages = [m for m in read_recording(path) if not (isinstance(m, FilterCall) and m.name == "constrain")]
    monkeypatch.setattr(replay_module, "read_recording", lambda _: iter(messages))
    return replay(path)


def test_rows_of_live_barriers_and_of_the_user_are_replayed(tmp_path, monkeypatch):
    second = ConstraintRow(name="user_rows: second", a=(0.0, 1.0, *(0.0,) * (MODEL.n - 2)), b=0.01)
    path, trace = record(tmp_path, (SwayBarrier(), SingularityBarrier(MODEL.alpha)), [second])
    assert np.all(trace["u"][1:, 1] > 0.009), "the row of the user is met"
    assert np.ptp(trace["u"][50:, 0]) > 0.01, "and the live one, which changes"
    result = replay(path)
    assert result.ticks == len(trace) > 250
    assert (result.identical, result.worst) == (True, {})
    assert not replay_without_rows(monkeypatch, path).identical


def test_unchanged_rows_are_recorded_once(tmp_path):
    first = ConstraintRow(name="user_rows: first", a=(1.0, *(0.0,) * (MODEL.n - 1)), b=0.01)
    path, _ = record(tmp_path, (), [first])
    calls = [m for m in read_recording(path) if isinstance(m, FilterCall) and m.name == "constrain"]
    assert len(calls) == 1
    assert replay(path).identical
