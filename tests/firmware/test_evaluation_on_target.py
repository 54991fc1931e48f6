"""An episode of the evaluation whose filter runs on an emulated board: the same row as on the host."""

import dataclasses
import time

import msgspec
import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.evaluation.episodes.case_runner import EpisodeResources, run_case
from dualbrain.evaluation.episodes.rerun import find_differences
from dualbrain.evaluation.episodes.scoring import EpisodeContext, score_episode
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Task, check_suite, load_suite
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.scripted import ScriptedPlanner

GO = {
    "skill": "move_to",
    "params": {"target": "red_cube", "speed": 0.3, "clearance": 0.2, "route": "direct", "wait": "none"},
}
CONTEXT = EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True)


def run_episode(method, target):
    """The case and the run of one motion above the cube, with the filter on `target`."""
    registry = load_skill_registry("panda")
    context = {"robot": "panda", "registry": registry.hash}
    text = msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": [GO]}).decode()
    case = dataclasses.replace(
        make_case(Task(family="clutter_grasp"), 40_000, "panda", 0), instruction="move above the red cube"
    )
    resources = EpisodeResources(
        id="e-1", planner=ScriptedPlanner([text]), clock=time.perf_counter, planning_time=0.1, target=target
    )
    return case, run_case(case, METHODS[method], resources)


def test_an_episode_on_a_board_is_that_of_the_host():
    case, on_host = run_episode("B3", "")
    _, on_board = run_episode("B3", "an386")
    row = score_episode(case, METHODS["B3"], on_host, CONTEXT)
    assert on_host.episode.outcome.duration > 1.0
    assert find_differences(row, on_board) == []
    assert on_board.trace["u"].tobytes() == on_host.trace["u"].tobytes()
    (note,) = [event.text for event in on_board.trace.events if event.kind == "target"]
    steps = len(on_board.trace["u"])
    assert note == f"an386: {steps} steps on target and host, 0 with different bits"


def test_an_unguarded_method_needs_no_board():
    _, run = run_episode("B1", "an386")
    assert [event for event in run.trace.events if event.kind == "target"] == []


def test_an_unknown_board_of_a_suite_is_refused():
    with pytest.raises(UnknownNameError, match="'an9' is not a board"):
        check_suite(msgspec.structs.replace(load_suite("smoke"), target="an9"))
