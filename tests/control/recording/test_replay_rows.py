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
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.barriers.singularity import SingularityBarrier
from dualbrain.safety.cbf.filter import ConstraintRow, SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact
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


def record_with_pause(folder):
    """A recording with a pause while the arm moves and all tables of the filter change, and all its ticks."""
    path, robot, trace = folder / "episode.mcap", Follower(), Trace(MODEL.n)
    safety = SafetyFilter(MODEL, barriers=(SwayBarrier(),))
    with Recorder(path, trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True, "instruction": ""})
        log = FlightLog(trace, recorder)
        loop = ControlLoop(MODEL, robot, robot, safety, log, ControlLoopConfig())
        loop.hold(0.1)
        log.pause(robot.state.stamp, "a test")
        log.pause(robot.state.stamp, "a test")
        loop.hold(0.1)
        spheres, permits = np.array([[0.0, 0.0, 0.2, 0.15]]), [Contact("hand", "table", 0.1)]
        log.call(0.0, "attach", spheres=spheres, error=0.001)
        safety.attach(spheres, 0.001)
        log.call(0.0, "permit", permits=permits)
        safety.permit(permits)
        loop.hold(0.1)
        assert log.resume(robot.state.stamp)
        assert not log.resume(robot.state.stamp)
        log.call(robot.state.stamp, "reset", u_prev=loop.safety_controller.clear_filter_memory())
        assert loop.safety_controller.commanded_speed > 0.01
        loop.hold(0.2)
    return path, trace


def test_a_replay_is_exact_across_a_pause_in_which_all_tables_changed(tmp_path, monkeypatch):
    path, trace = record_with_pause(tmp_path)
    result = replay(path)
    assert (result.identical, result.complete) == (True, True)
    assert result.ticks == len(trace) - 200
    messages = list(read_recording(path))
    resumed = next(k for k, m in enumerate(messages) if isinstance(m, Event) and "continues" in m.text)
    calls = [m.name for m in messages[resumed + 1 :] if isinstance(m, FilterCall)]
    assert calls[:5] == ["constrain", "attach", "observe", "permit", "reset"]
    rest = [m for m in messages if not (isinstance(m, FilterCall) and m.name == "reset")]
    monkeypatch.setattr(replay_module, "read_recording", lambda _: iter(rest))
    assert not replay(path).identical, "the reset is needed"
