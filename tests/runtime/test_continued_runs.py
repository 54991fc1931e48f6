"""A run that begins where another ended: the object in the hand is placed by a contract that never grasped it."""

from dataclasses import replace

import pytest

from dualbrain.control.recording.replay import replay
from dualbrain.errors import ConfigurationError
from dualbrain.runtime.run_folder import END_STATE_FILE
from dualbrain.runtime.session import RunObserver, Session
from dualbrain.simulation.plant.end_state import load_end_state
from dualbrain.simulation.scenes.scene_spec import load_scene
from tests.stories.story_session import GRASP, PLACE, contract_text, make_clocks, run_config


def run_contract(folder, name, *actions, **changes):
    (folder / f"{name}.json").write_text(contract_text(*actions))
    config = run_config(folder, name, contract=folder / f"{name}.json", **changes)
    with Session(replace(config, instruction=""), make_clocks(), {}) as session:
        return config.out, session.run(RunObserver()).episode


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("continued")
    first, _ = run_contract(folder, "first", ("grasp", GRASP))
    second, episode = run_contract(folder, "second", ("place", PLACE), after=first)
    return first, second, episode


def test_the_second_run_places_the_object_that_the_first_one_grasped(two_runs):
    first, second, episode = two_runs
    assert load_end_state(first / END_STATE_FILE).held == "red_cube"
    assert (episode.outcome.kind, episode.outcome.reason) == ("succeeded", "red_cube is at blue_bowl")
    end = load_end_state(second / END_STATE_FILE)
    cube, bowl = end.scene.find("red_cube"), end.scene.find("blue_bowl")
    assert end.held == ""
    assert cube.position[:2] == pytest.approx(bowl.position[:2], abs=0.03)


def test_the_senses_judge_the_object_that_was_in_the_hand_at_the_beginning(two_runs):
    _, _, episode = two_runs
    (one,) = episode.outcome.grips
    assert (one.object_name, one.released) == ("red_cube", True)
    verdicts = {one.sense: one.verdict for one in episode.senses}
    assert {verdicts[name] for name in ("placed", "intact", "undisturbed")} == {"confirmed"}
    assert episode.second_opinion == "agrees"


def test_the_second_run_begins_with_the_scene_at_the_end_of_the_first(two_runs):
    first, second, _ = two_runs
    assert load_scene(second / "scene.json") == load_end_state(first / END_STATE_FILE).scene


def test_the_continued_run_is_recomputed_bit_for_bit(two_runs):
    _, second, _ = two_runs
    assert replay(second / "episode.mcap").identical


def test_the_end_of_a_run_of_another_robot_is_refused(two_runs, tmp_path):
    config = run_config(tmp_path, after=two_runs[0], robot="fr3")
    with pytest.raises(ConfigurationError, match="for robot 'panda', not for 'fr3'"):
        Session(config, make_clocks(), {})
