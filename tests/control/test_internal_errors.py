"""Exceptions inside the loop: the drive is switched off, the outcome names the error, and all records are written."""

import json
from dataclasses import replace
from threading import Timer

import msgspec
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Rejected
from dualbrain.control import contract_executor
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs
from dualbrain.control.recording import recorder as recorder_module
from dualbrain.control.recording.channels import recording_state
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants
from dualbrain.memory.memory import Memory
from dualbrain.records import Episode
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.stories.story_session import hold_contract, run_config, run_session

MODEL = load_robot("panda")
GRASP = {
    "object": "red_cube",
    "speed": 0.2,
    "clearance": 0.1,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 10.0,
}


class World:
    """A robot at rest in the scene `scene_at(t)`."""

    def __init__(self, scene_at):
        self.state, self.scene_at, self.stopped = home_state(MODEL), scene_at, False

    def read(self):
        return self.state

    def write(self, command):
        pass

    def stop(self):
        self.stopped = True

    def perceive(self):
        return msgspec.structs.replace(self.scene_at(self.state.stamp), stamp=self.state.stamp)

    def advance(self):
        state = self.state
        self.state = replace(state, stamp=state.stamp + MODEL.period, sequence=state.sequence + 1)


def scene_with_posts(count):
    return scene(*(box(f"post_{index}", 0.9, 0.6 - 0.02 * index, role="obstacle") for index in range(count)))


def run(scene_at, *actions, interrupted=lambda: False):
    world = World(scene_at)
    log = FlightLog(Trace(MODEL.n))
    executor = ContractExecutor(
        ControlLoop(
            MODEL,
            world,
            world,
            SafetyFilter(MODEL),
            log,
            ControlLoopConfig(settle_time=0.1),
            inputs=LoopInputs(interrupted=interrupted),
        )
    )
    return world, executor.execute(Contract("c-1", Context("panda", ""), actions)), log.trace


def test_a_target_that_disappeared_ends_the_contract_stopped():
    world, outcome, trace = run(lambda t: scene(bowl()), Action("grasp", GRASP), Action("home", {"speed": 0.2}))
    assert outcome.kind == "stopped"
    assert outcome.reason.startswith("UnknownNameError: 'red_cube' is not a scene object")
    assert [action.status for action in outcome.actions] == ["stopped", "not_run"]
    assert world.stopped
    assert any("Traceback" in event.data.get("traceback", "") for event in trace.events)


@pytest.mark.parametrize("when", [0.05, 0.45], ids=["in the action", "while it settles"])
def test_more_obstacles_than_the_kernel_takes_end_the_contract_stopped(when):
    world, outcome, _ = run(lambda t: scene_with_posts(600 if t > when else 3), Action("hold", {"duration": 0.4}))
    assert outcome.kind == "stopped"
    assert "at most 512 obstacles" in outcome.reason
    assert world.stopped


def test_a_fault_after_an_interruption_leaves_it_an_interruption():
    world, outcome, _ = run(
        lambda t: scene_with_posts(600 if t > 0.02 else 3), Action("hold", {"duration": 0.4}), interrupted=lambda: True
    )
    assert outcome.kind == "aborted"
    assert world.stopped


def test_an_action_that_never_ends_is_taken_over(monkeypatch):
    monkeypatch.setattr(contract_executor, "MAX_ACTION_TIME", 0.2)
    world, outcome, _ = run(lambda t: scene(), Action("hold", {"duration": 20.0}))
    assert (outcome.kind, outcome.reason) == ("taken_over", "hold: not done after 0 s")
    assert not world.stopped


def test_a_rule_that_raises_rejects_the_contract():
    def broken_rule(contract):
        raise ZeroDivisionError("no such thing")

    registry = load_skill_registry("panda")
    gate = Gate(registry, planner_grants(registry), (broken_rule,))
    text = {
        "id": "c-0001",
        "context": {"robot": "panda", "registry": registry.hash},
        "action_sequence": [{"skill": "hold", "params": {"duration": 1.0}}],
    }
    verdict = gate.check(json.dumps(text).encode(), names=SceneNames((), ()), principal=PLANNER, now=0.0)
    assert isinstance(verdict, Rejected)
    assert (verdict.stage, verdict.got) == ("envelope", "ZeroDivisionError: no such thing")


def test_an_episode_is_saved_even_if_memory_cannot_store_it(tmp_path, monkeypatch):
    def full(self, episode, state, **more):
        raise OSError("no space left")

    monkeypatch.setattr(Memory, "store", full)
    config = run_config(tmp_path)
    with pytest.raises(OSError, match="no space left"):
        run_session(config, hold_contract())
    episode = msgspec.json.decode((config.out / "episode.json").read_bytes(), type=Episode)
    assert episode.outcome.kind == "succeeded"


def test_a_failing_writer_does_not_block_the_loop_and_marks_the_recording_incomplete(tmp_path, monkeypatch):
    def broken(self, batch):
        raise MemoryError("no room")

    monkeypatch.setattr(recorder_module.Recorder, "_ticks", broken)
    trace = Trace(7)
    recorder = Recorder(tmp_path / "episode.mcap", trace, capacity=2, when_full="wait")
    alarm = Timer(20.0, recorder._queue.queue.clear)  # so that a failing test ends
    alarm.daemon = True
    alarm.start()
    for k in range(20):
        recorder._pending = [trace.rows]
        recorder.event(Event(float(k), "phase", "go"))
    state = recorder.close()
    assert alarm.is_alive()
    alarm.cancel()
    assert not state.complete
    assert "MemoryError" in recording_state(tmp_path / "episode.mcap").problem
