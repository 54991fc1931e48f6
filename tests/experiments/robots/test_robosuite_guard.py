"""The parts of experiment `robosuite_guard` that need no robosuite: units, judge and tables."""

from types import SimpleNamespace

import mujoco
import pytest

from experiments.engine.experiment import Options
from experiments.robots.robosuite_guard.contact_judge import ContactJudge
from experiments.robots.robosuite_guard.experiment import MODES, POLICIES, SEEDS_PER_BATCH, TASKS, RobosuiteGuard

SCENE = """
<mujoco><worldbody>
  <body name="table"><geom type="plane" size="1 1 1"/></body>
  <body name="cube_main" pos="0 0 {cube}"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  <body name="robot0_link7" pos="0.3 0 {link}"><freejoint/><geom type="sphere" size=".05"/></body>
  <body name="gripper0_right_leftfinger" pos="0 0 {finger}"><freejoint/><geom type="sphere" size=".02"/></body>
</worldbody></mujoco>
"""


def judged(task, cube=0.5, link=0.5, finger=1.0):
    model = mujoco.MjModel.from_xml_string(SCENE.format(cube=cube, link=link, finger=finger))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    sim = SimpleNamespace(model=SimpleNamespace(_model=model), data=SimpleNamespace(_data=data))
    judge = ContactJudge(SimpleNamespace(sim=sim), task)
    judge.update()
    return judge.outside


def test_the_judge_counts_contacts_of_the_arm_except_with_the_manipulated_object():
    assert judged("Lift") == {}
    assert judged("Lift", cube=0.019) == {}, "the cube is on the table"
    assert list(judged("Lift", link=0.049)) == ["link7 and table"]
    assert judged("Lift", link=0.049)["link7 and table"] > 0.0
    assert judged("Lift", cube=0.5, finger=0.538) == {}
    assert list(judged("Stack", cube=0.5, finger=0.538)) == ["cube_main and leftfinger"]


def test_every_mode_has_the_same_tasks_policies_and_seeds(tmp_path):
    units = RobosuiteGuard().units(Options(folder=tmp_path, planner=""))
    assert len({unit.key for unit in units}) == len(units)
    batch = [unit.parameters for unit in units[: len(units) // 2]]
    found = {
        mode: {(one["task"], one["policy"], one["seed"]) for one in batch if one["mode"] == mode} for mode in MODES
    }
    assert found["guarded"] == found["unguarded"] == found["clamped"]
    assert len(found["guarded"]) == len(TASKS) * len(POLICIES) * SEEDS_PER_BATCH


def row(mode, **changes):
    found = {
        "key": f"Lift careful {mode} 0",
        "task": "Lift",
        "policy": "careful",
        "mode": mode,
        "steps": 100,
        "changed": 25,
        "h_min": 0.004,
        "strayed": 0.5,
        "status": {"SAFE": 75, "MODIFIED": 25},
        "cpu": 20.0,
        "success": True,
        "outside": {},
        "links": {},
        "versions": {"robosuite": "1.5.2"},
    }
    return found | changes


def test_the_tables_show_contacts_and_every_guarded_episode_that_failed():
    touched = {"leftfinger and table": 12.5}
    lines = "\n".join(RobosuiteGuard().report([row("unguarded", outside=touched), row("guarded")]))
    assert "12.5 N" in lines
    assert "25.0%" in lines
    assert "No guarded episode had a contact" in lines
    for change in ({"outside": touched}, {"success": False}, {"status": {"FAULT": 1}}):
        lines = "\n".join(RobosuiteGuard().report([row("guarded", **change)]))
        assert "| Lift careful guarded 0 |" in lines, change


@pytest.mark.parametrize("mode", MODES)
def test_a_row_is_summarized_with_its_contacts(mode):
    assert RobosuiteGuard().summarize_row(row(mode)) == "success in 100 steps; no contact"
    assert "table 12.5 N" in RobosuiteGuard().summarize_row(row(mode, outside={"leftfinger and table": 12.5}))
