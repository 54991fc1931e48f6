"""Limits of a site on an object: the planner learns them from the rejection, and the arm keeps them."""

import numpy as np

from dualbrain.records import ObjectLimits
from tests.stories.story_session import GRASP, PLACE, contract_text, run_config, run_session

SITE = "[object.red_cube]\nforce = 6.0\nspeed = 0.1\nclearance = 0.2\n\n[object.teapot]\nspeed = 0.1\n"
SLOW_GRASP = GRASP | {"force": 6.0, "speed": 0.1, "clearance": 0.2}
SLOW_PLACE = PLACE | {"speed": 0.1, "clearance": 0.2}


def carrying_force(story):
    """The largest force on a finger [N] while the object is carried; the first contact of the fingers is higher."""
    trace = story.result.trace
    carrying = np.array([trace.phases[int(code)] == "carry" for code in trace["phase"]])
    return float(trace["forces"][carrying].max())


def test_a_contract_beyond_the_limits_is_rejected_and_the_next_one_keeps_them(tmp_path):
    site = tmp_path / "lab.toml"
    site.write_text(SITE)
    fast = contract_text(("grasp", GRASP), ("place", PLACE))
    slow = contract_text(("grasp", SLOW_GRASP), ("place", SLOW_PLACE))
    story = run_session(run_config(tmp_path, site=site), fast, slow)
    rejected, accepted = story.episode.attempts
    assert rejected.verdict.pointer == "/action_sequence/0/params/speed"
    assert "force at most 6 N, speed at most 0.1 m/s, clearance at least 0.2 m (lab.toml:1)" in rejected.verdict.hint
    assert story.planner.requests[1].rejection == rejected.verdict
    assert accepted.verdict.contract.action_sequence[1].params["speed"] == 0.1
    assert story.episode.outcome.kind == "succeeded"
    assert story.stored_episode.scene.find("red_cube").limits == ObjectLimits(
        force=6.0, speed=0.1, clearance=0.2, source="lab.toml:1"
    )
    assert 1.0 < carrying_force(story) <= 6.0 * 1.05
    texts = [event.text for event in story.result.trace.events if event.kind == "site"]
    assert texts[0].startswith("limits of the site for red_cube: force at most 6 N")
    assert "'teapot'" in texts[1]
    assert len(texts) == 2


def test_without_the_limits_the_same_contract_is_accepted(tmp_path):
    story = run_session(run_config(tmp_path), contract_text(("grasp", GRASP), ("place", PLACE)))
    assert len(story.episode.attempts) == 1
    assert carrying_force(story) > 6.0 * 1.05
    assert all(obj.limits is None for obj in story.episode.scene.objects)
