"""Where nobody is named, the small planner plans for the robot that it knows, and the large one for any other."""

import json

import pytest

from dualbrain.adaptation.serving.default_planner import STARTER, default_planner
from dualbrain.adaptation.serving.packaged import packaged_names
from dualbrain.planner.registry import LARGE_PLANNER
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime import session as session_module
from dualbrain.runtime.session import Onlooker, Session
from tests.stories.rig import pause, settings, times


@pytest.mark.parametrize(
    ("robot", "planner"),
    [("panda", STARTER), ("ur5e", LARGE_PLANNER), ("base", LARGE_PLANNER), ("of_mine", LARGE_PLANNER)],
)
def test_an_adapter_plans_only_for_the_robot_that_it_was_taught(robot, planner):
    assert STARTER in packaged_names()
    assert default_planner(robot) == planner


@pytest.mark.parametrize(("named", "opened"), [("", STARTER), ("base-135m", "base-135m")])
def test_a_run_writes_down_who_planned_where_nobody_was_named(tmp_path, monkeypatch, named, opened):
    asked = []

    def open_planner(name, *others, **settings):
        asked.append(name)
        return ScriptedPlanner([pause()])

    monkeypatch.setattr(session_module, "open_planner", open_planner)
    config = settings(tmp_path, planner=named)
    with Session(config, times(), {}) as session:
        session.run(Onlooker())
    assert asked == [opened]
    assert json.loads((config.out / "config.json").read_bytes())["planner"] == opened
