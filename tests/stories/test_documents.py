"""Documents in a run: passages in the prompt are recorded; by default they are those of the operator alone."""

import pytest

from dualbrain.cli.knowledge import add
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.prompt.full_prompt import render
from dualbrain.records import Exemplar
from dualbrain.simulation.scenes.scene_spec import load_scene
from tests.stories.story_session import contract_text, hold_contract, run_config, run_session

MAP = """
kind = "map"
title = "Hall of a base"
frame = "corner"
[[frames]]
name = "start"
position = [1.0, 2.0, 0.0]
yaw = 1.5707963267948966
[[places]]
name = "waiting_spot"
position = [0.4, 3.0, 0.0]
[[regions]]
name = "hall"
use = "traversable"
corners = [[-0.4, 1.2], [2.4, 1.2], [2.4, 4.5], [-0.4, 4.5]]
"""


def test_passages_are_shown_and_recorded_and_places_of_a_map_are_in_the_scene(tmp_path):
    store = tmp_path / "knowledge.sqlite"
    move = {"target": "inspection_spot", "speed": 0.2, "clearance": 0.2, "route": "direct", "wait": "none"}
    words = "put the red cube in the bowl via the inspection spot"
    config = run_config(tmp_path, "with", instruction=words, knowledge=store, consult="on", map="room-map:panda_table")
    story = run_session(config, contract_text(("move_to", move)))
    passages = story.planner.requests[0].recall.passages
    assert 1 <= len(passages) <= 3
    assert story.stored_episode.recall.passages == passages == story.episode.recall.passages
    last = render(story.planner.requests[0])[-1]["content"]
    assert all(one.citation in last for one in passages)
    assert "inspection_spot" in story.planner.requests[0].scene
    assert story.episode.outcome.kind == "succeeded"
    assert story.episode.contract["action_sequence"][0]["params"]["target"] == "inspection_spot"

    without = run_session(run_config(tmp_path, "without", knowledge=store, consult="off"), hold_contract())
    assert without.planner.requests[0].recall.passages == () == without.episode.recall.passages
    assert all(isinstance(one, Exemplar) for one in without.episode.recall.exemplars)


def test_by_default_only_documents_of_trust_site_are_read(tmp_path):
    store, rules, leaflet = tmp_path / "knowledge.sqlite", tmp_path / "rules.md", tmp_path / "leaflet.md"
    rules.write_text("# Rules\n\nThe red cube must be gripped with at most 8 N.\n")
    leaflet.write_text("# Leaflet\n\nThe red cube of this maker weighs 90 g.\n")
    assert add(rules, trust="site", store=store) == add(leaflet, trust="vendor", store=store) == 0
    words = "put the red cube in the bowl"
    cited = {}
    for consult in ("site", "on", "off"):
        options = {} if consult == "site" else {"consult": consult}
        story = run_session(
            run_config(tmp_path, consult, instruction=words, knowledge=store, **options), hold_contract()
        )
        cited[consult] = {one.citation.partition("@")[0] for one in story.planner.requests[0].recall.passages}
    assert cited["site"] == {"rules"}
    assert {"rules", "leaflet"} <= cited["on"]
    assert not cited["off"]


def test_without_own_documents_a_run_makes_no_store(tmp_path):
    store = tmp_path / "knowledge.sqlite"
    run_session(run_config(tmp_path, "run", knowledge=store), hold_contract())
    assert not store.exists()


def test_a_base_drives_to_a_place_of_its_map_and_the_floor_of_the_map_is_recorded(tmp_path):
    store, file = tmp_path / "knowledge.sqlite", tmp_path / "hall.toml"
    file.write_text(MAP)
    assert add(file, trust="site", store=store) == 0
    drive = ("drive_to", {"place": "waiting_spot", "max_speed": 0.5, "max_turn_rate": 1.2})
    contract = contract_text(drive, robot="base", registry=load_skill_registry("base").hash)
    base = {
        "instruction": "go to the waiting spot",
        "robot": "base",
        "scene": "empty_room:0",
        "knowledge": store,
        "map": "hall:start",
    }
    story = run_session(run_config(tmp_path, "with", goal="go to waiting_spot", **base), contract)
    assert story.episode.outcome.kind == "succeeded"
    assert story.stored_episode.judgement.success
    assert story.stored_episode.judgement.violations == ()
    floor = load_scene(tmp_path / "with" / "scene.json").floor
    assert sorted((round(x, 6), round(y, 6)) for x, y in floor) == [(-0.8, -1.4), (-0.8, 1.4), (2.5, -1.4), (2.5, 1.4)]
    assert story.stored_episode.scene.region == floor

    file.write_text(MAP.replace("[0.4, 3.0, 0.0]", "[2.9, 3.0, 0.0]"))  # 0.5 m on the other side of the border
    assert add(file, trust="site", store=store) == 0
    with pytest.raises(ConfigurationError, match="'waiting_spot' of the map"):
        run_session(run_config(tmp_path, "refused", **base), contract)
