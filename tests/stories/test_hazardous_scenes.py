"""Scenes that are dangerous or impossible from the start: nothing is hit, and the end is told and recorded."""

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
    """A file with the bare scene after `change(things)`."""
    spec = open_scene("bare:0")
    path = folder / "scene.json"
    save_scene(msgspec.structs.replace(spec, things=change(spec.objects)), path)
    return str(path)


def test_a_thing_out_of_reach_is_refused_before_anything_moves(tmp_path):
    def away(things):
        cube, *others = things
        return (msgspec.structs.replace(cube, position=(0.92, -0.6, 0.025)), *others)

    story = run_session(run_config(tmp_path, scene=scene_file(tmp_path, away)), PICK)
    for attempt in story.episode.attempts:
        assert isinstance(attempt.verdict, Rejected)
        assert (attempt.verdict.stage, attempt.verdict.pointer) == ("envelope", "/action_sequence/0/params/object")
        assert "out of reach" in attempt.verdict.hint
    assert story.displacement < 1e-6
    assert exit_code(story.episode) == ExitCode.REJECTED


WALL = ObjectSpec(
    name="wall",
    role="obstacle",
    shape=Box((0.02, 0.25, 0.30)),
    position=(0.40, 0.0, 0.30),
    mass=1.0,
    colour="grey",
    category="wall",
    fixed=True,
)
"""It stands through the forearm of an arm at home."""


def _pressed(folder):
    story = run_session(run_config(folder, scene=scene_file(folder, lambda things: (*things, WALL))), PICK)
    return story.episode, story.displacement, story.config


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    return run_once(tmp_path_factory, "pressed", _pressed)[1:]


def test_an_obstacle_on_top_of_the_robot_ends_the_contract_safely(pressed):
    episode, _, config = pressed
    assert episode.outcome.kind in ("stopped", "taken_over", "failed")
    assert "'wall'" in episode.outcome.hindrance  # what held it back is named, for whoever plans again
    assert episode.outcome.reason
    assert exit_code(episode) in (ExitCode.FAILED_SAFELY, ExitCode.VIOLATION)  # the overlap itself may count as touch
    (remembered,) = ledger_episodes(config.ledger)
    assert remembered["episode"]["outcome"]["kind"] == episode.outcome.kind


def test_an_obstacle_on_top_of_the_robot_is_not_driven_into(pressed):
    """h never falls below where it began: the arm may leave the obstacle, never go deeper."""
    h = read_trace(pressed[2].out / "episode.mcap")["h_min"]
    assert h[0] < 0.0
    assert np.min(h) >= h[0] - 1e-3
    assert replay(pressed[2].out / "episode.mcap").identical
