"""Documents in a whole run: what the planner was shown is on record, and only when it was asked for."""

from dualbrain.planner.prompt import render
from dualbrain.records import Exemplar
from tests.stories.rig import contract, pause, play, settings


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
