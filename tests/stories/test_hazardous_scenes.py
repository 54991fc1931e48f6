"""Scenes that are dangerous or infeasible from the start: no collision, and the outcome is reported and recorded."""

import msgspec
import numpy as np
import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.execution import exit_code
from dualbrain.contracts.verdict import Rejected
from dualbrain.control.recording.channels import read_trace
from dualbrain.control.recording.replay import replay
from dualbrain.core.geometry.shapes import Box
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, save_scene
from tests.stories.story_session import GRASP, PLACE, contract_text, ledger_episodes, run_config, run_session
from tests.support.run_once import run_once

PICK = contract_text(("grasp", GRASP), ("place", PLACE))


def scene_file(folder, change):
    """A file with the bare scene after `change(objects)`."""
    spec = open_scene("bare:0")
    path = folder / "scene.json"
    save_scene(msgspec.structs.replace(spec, objects=change(spec.objects)), path)
    return str(path)


def test_an_object_out_of_reach_is_rejected_before_any_motion(tmp_path):
    def move_away(objects):
        cube, *others = objects
        return (msgspec.structs.replace(cube, position=(0.92, -0.6, 0.025)), *others)

    story = run_session(run_config(tmp_path, scene=scene_file(tmp_path, move_away)), PICK)
    for attempt in story.episode.attempts:
        assert isinstance(attempt.verdict, Rejected)
        assert (attempt.verdict.stage, attempt.verdict.pointer) == ("envelope", "/action_sequence/0/params/object")
        assert "out of reach" in attempt.verdict.hint
    assert story.displacement < 1e-6
    assert exit_code(story.episode) == ExitCode.REJECTED


WALL = ObjectSpec(
    name="wall",
    role="obstacle",
    shape=Box((0.02, 0.15, 0.30)),
    position=(0.40, 0.0, 0.30),
    mass=1.0,
    colour="grey",
    category="wall",
    fixed=True,
)
"""A wall through the forearm of an arm at its home position."""


def _run_in_contact(folder):
    story = run_session(run_config(folder, scene=scene_file(folder, lambda objects: (*objects, WALL))), PICK)
    return story.episode, story.displacement, story.config


@pytest.fixture(scope="module")
def run_in_contact(tmp_path_factory):
    return run_once(tmp_path_factory, "run_in_contact", _run_in_contact)[1:]


def test_an_obstacle_inside_the_robot_ends_the_contract_safely(run_in_contact):
    episode, _, config = run_in_contact
    assert episode.outcome.kind in ("stopped", "taken_over", "failed")
    assert "'wall'" in episode.outcome.active_constraints  # the constraint is named for replanning
    assert episode.outcome.reason
    assert exit_code(episode) in (ExitCode.FAILED_SAFELY, ExitCode.VIOLATION)  # the overlap itself may count as contact
    (remembered,) = ledger_episodes(config.ledger)
    assert remembered["episode"]["outcome"]["kind"] == episode.outcome.kind


def test_the_robot_does_not_move_deeper_into_an_obstacle_inside_it(run_in_contact):
    """h never falls below its initial value: the arm may leave the obstacle, and must not move deeper into it."""
    h = read_trace(run_in_contact[2].out / "episode.mcap")["h_min"]
    assert h[0] < 0.0
    assert np.min(h) >= h[0] - 1e-3
    assert replay(run_in_contact[2].out / "episode.mcap").identical
