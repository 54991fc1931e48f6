"""Documents in a whole run: what the planner was shown is on record, and only when it was asked for."""

import pytest

from dualbrain.cli.knowledge import add
from dualbrain.errors import InvalidSetup
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.planner.prompt.full_prompt import render
from dualbrain.records import Exemplar
from dualbrain.simulation.scenes.scene_spec import load_scene
from tests.stories.story_session import contract, pause, play, settings

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


def test_passages_reach_the_planner_and_the_record_and_places_of_a_map_the_scene(tmp_path):
    shelf = tmp_path / "knowledge.sqlite"
    move = {"target": "inspection_spot", "speed": 0.2, "clearance": 0.2, "route": "direct", "wait": "none"}
    config = settings(tmp_path, "with", knowledge=shelf, consult=True, map="room-map:panda_table")
    told = play(config, contract(("move_to", move)))
    shown = told.planner.asked[0].recall.passages
    assert 1 <= len(shown) <= 3
    assert told.written.recall.passages == shown == told.episode.recall.passages
    last = render(told.planner.asked[0])[-1]["content"]
    assert all(one.citation in last for one in shown)
    assert "inspection_spot" in told.planner.asked[0].scene
    assert told.episode.outcome.kind == "succeeded"
    assert told.episode.contract["action_sequence"][0]["params"]["target"] == "inspection_spot"

    silent = play(settings(tmp_path, "without", knowledge=shelf), pause())
    assert silent.planner.asked[0].recall.passages == () == silent.episode.recall.passages
    assert all(isinstance(one, Exemplar) for one in silent.episode.recall.exemplars)


def test_a_base_drives_by_its_map_to_a_place_of_it_and_the_map_s_floor_is_on_record(tmp_path):
    shelf, file = tmp_path / "knowledge.sqlite", tmp_path / "hall.toml"
    file.write_text(MAP)
    assert add(file, trust="site", store=shelf) == 0
    drive = ("drive_to", {"place": "waiting_spot", "max_speed": 0.5, "max_turn_rate": 1.2})
    given = contract(drive, robot="base", registry=vocabulary("base").hash)
    base = {"robot": "base", "scene": "empty_room:0", "knowledge": shelf, "map": "hall:start"}
    told = play(settings(tmp_path, "with", goal="go to waiting_spot", **base), given)
    assert told.episode.outcome.kind == "succeeded"
    assert told.written.judgement.success
    assert told.written.judgement.violations == ()
    floor = load_scene(tmp_path / "with" / "scene.json").floor
    assert sorted((round(x, 6), round(y, 6)) for x, y in floor) == [(-0.8, -1.4), (-0.8, 1.4), (2.5, -1.4), (2.5, 1.4)]
    assert told.written.scene.region == floor

    file.write_text(MAP.replace("[0.4, 3.0, 0.0]", "[2.9, 3.0, 0.0]"))  # 0.5 m on the other side of the border
    assert add(file, trust="site", store=shelf) == 0
    with pytest.raises(InvalidSetup, match="'waiting_spot' of the map"):
        play(settings(tmp_path, "refused", **base), given)
