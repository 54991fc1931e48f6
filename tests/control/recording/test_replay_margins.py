"""A replay finds the same falls of h below 0, with the same causes, as the control loop did."""

import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig
from dualbrain.control.obstacle_estimates import INTRODUCTION_RATE, RESERVE
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.records import MarginCause, Scene, SceneObject
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.control.recording.test_replay_rows import MODEL, Follower

RADIUS, ERROR, GAP, JUMP, JUMP_TIME = 0.02, 0.009, 0.012, 0.0195, 0.15


class JumpingCup(Follower):
    """A robot that follows its commands, and a cup beside its hand that is seen nearer by 19.5 mm after 0.15 s."""

    def __init__(self):
        super().__init__()
        centres, radii, groups = SafetyFilter(MODEL).spheres(self.state.q, self.state.opening)
        hand = max((i for i, group in enumerate(groups) if group == "hand"), key=lambda i: centres[i, 0] + radii[i])
        self.place = centres[hand] + np.array([radii[hand] + RADIUS + ERROR + GAP, 0.0, 0.0])

    def perceive(self):
        now = self.state.stamp
        x, y, z = (self.place - np.array([JUMP if now > JUMP_TIME else 0.0, 1e-7 * now, 0.0])).tolist()
        cup = SceneObject(name="cup", role="object", shape=Sphere(RADIUS), pose=Pose((x, y, z)), error=ERROR, stamp=now)
        return Scene(robot="panda", stamp=now, version=1, objects=(cup,))


def run_hold(folder, *, keep_margins):
    """The outcome of a short hold, the trace and the recording."""
    path, robot, trace = folder / "episode.mcap", JumpingCup(), Trace(MODEL.n)
    with Recorder(path, trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True, "instruction": ""})
        config = ControlLoopConfig(settle_time=0.05, keep_margins=keep_margins)
        loop = ControlLoop(MODEL, robot, robot, SafetyFilter(MODEL), FlightLog(trace, recorder), config)
        outcome = ContractExecutor(loop).execute(
            Contract("c-1", Context("panda", ""), (Action("hold", {"duration": 0.6}),))
        )
    return outcome, trace, path


def test_a_jump_is_recorded_with_its_cause_and_replayed(tmp_path):
    outcome, trace, path = run_hold(tmp_path, keep_margins=False)
    assert outcome.h_min == pytest.approx(GAP - JUMP, abs=1e-4)
    (found,) = outcome.margin_shortfalls
    assert (found.cause, found.pair, found.introduced) == (MarginCause.PERCEPTION_JUMP, "hand vs 'cup'", False)
    assert found.h_min == outcome.h_min
    assert found.start == pytest.approx(JUMP_TIME, abs=0.04)
    (event,) = [event for event in trace.events if event.kind == "margin"]
    assert event.data == {"pair": "hand vs 'cup'", "cause": "perception_jump"}
    result = replay(path)
    assert result.identical
    assert result.margin_shortfalls == (found,)


def test_the_margin_of_an_object_that_moved_is_introduced_and_h_stays_above_0(tmp_path):
    outcome, trace, path = run_hold(tmp_path, keep_margins=True)
    assert outcome.h_min >= 0.0
    (found,) = outcome.margin_shortfalls
    assert (found.cause, found.introduced) == (MarginCause.PERCEPTION_JUMP, True)
    shortage = JUMP - GAP + RESERVE
    assert found.h_min == pytest.approx(-shortage, abs=1e-4)
    assert found.duration == pytest.approx(shortage / INTRODUCTION_RATE, rel=0.05)
    assert [event.kind for event in trace.events].count("margin") == 1
    assert replay(path).identical
