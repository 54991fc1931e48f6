"""Limits of a site on an object: the planner learns them from the rejection, and the arm keeps them."""

from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np

from dualbrain.agent_api import connection
from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
from dualbrain.records import ObjectLimits
from dualbrain.robots.loader import load_robot
from dualbrain.skills.registry import skill_registry
from tests.stories.story_session import (
    GRASP,
    PLACE,
    contract_text,
    hold_contract,
    ledger_episodes,
    run_config,
    run_session,
)

SITE = "[object.red_cube]\nforce = 6.0\nspeed = 0.1\nclearance = 0.2\n\n[object.teapot]\nspeed = 0.1\n"
SITE += '[person.visitor]\nmonitoring = "barrier"\n[person.others]\nmonitoring = "barrier"\n'
SLOW_GRASP = GRASP | {"force": 6.0, "speed": 0.1, "clearance": 0.2}
SLOW_PLACE = PLACE | {"speed": 0.1, "clearance": 0.2}


def hold_at(site):
    """A short contract in the vocabulary of the robot at the file `site`."""
    registry = skill_registry(open_robot_at_site("panda", site).robot_model).hash
    return contract_text(("hold", {"duration": 0.5}), registry=registry)


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
    assert texts[2].startswith("no person in this scene has the name 'visitor'")
    assert len(texts) == 3


def test_a_run_at_a_site_that_narrows_a_range_uses_the_memory_of_a_run_without_one(tmp_path):
    run_session(run_config(tmp_path, "first"), hold_contract())
    site = tmp_path / "lab.toml"
    site.write_text("[joint.panda_joint4]\nlower = -2.9\n")
    second = run_session(run_config(tmp_path, "second", site=site), hold_at(site))
    assert second.episode.outcome.kind == "succeeded"
    assert len({one["embedding"] for one in ledger_episodes(tmp_path / "ledger.sqlite")}) == 1


def test_agents_normalise_postures_with_the_limits_of_the_robot_without_its_site(tmp_path, monkeypatch):
    site = tmp_path / "lab.toml"
    site.write_text("[joint.panda_joint4]\nlower = -2.9\n")
    at_site = open_robot_at_site("panda", site)
    assert at_site.robot_model.joints[3].lower.value == -2.9
    welcome = SimpleNamespace(robot="panda", registry=skill_registry(at_site.robot_model).hash)
    client = SimpleNamespace(welcome=welcome, close=lambda: None)
    monkeypatch.setattr(connection, "GatekeeperClient", lambda *_, **__: client)
    monkeypatch.setattr(connection, "read_keys", lambda *_: {})
    with ExitStack() as stack:
        found = connection.connect(tmp_path / "socket", tmp_path, "", site, lambda _: None, stack)
    assert found.robot_model == at_site.robot_model
    assert found.model_without_site == load_robot("panda")


def test_without_the_limits_the_same_contract_is_accepted(tmp_path):
    story = run_session(run_config(tmp_path), contract_text(("grasp", GRASP), ("place", PLACE)))
    assert len(story.episode.attempts) == 1
    assert carrying_force(story) > 6.0 * 1.05
    assert all(obj.limits is None for obj in story.episode.scene.objects)
