"""The parts of experiment `mocap_guard` that need no suite: units, judge, policies and tables."""

import mujoco
import numpy as np
import pytest

from benchmarks.guards.mocap_guard.contact_judge import ContactJudge
from benchmarks.guards.mocap_guard.experiment import OPTION_MODES, POLICIES, SEEDS_PER_BATCH, TASKS, MocapGuard, modes
from benchmarks.guards.mocap_guard.policies import Low, RandomPolicy, Straight, make_policy
from benchmarks.guards.mocap_guard.virtual_environments import ENVIRONMENTS
from experiments.engine.experiment import Options

SCENE = """
<mujoco><asset><mesh name="ball" vertex="{vertices}"/></asset>
<worldbody>
  <body name="mocap" mocap="true"/>
  <body name="table"><geom type="box" size="1 1 .1" pos="0 0 -.1"/></body>
  <body name="thing" pos="0 0 2"><geom type="sphere" size=".1"/></body>
  <body name="stand" pos="3 0 0"><geom type="box" size=".1 .1 .1"/>
    <body name="link"><joint name="height" type="slide" axis="0 0 1"/>
      <geom type="mesh" mesh="ball" contype="0" conaffinity="0" pos="-3 0 0"/></body></body>
</worldbody></mujoco>"""
VERTICES = 0.1 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
MODEL = mujoco.MjModel.from_xml_string(SCENE.format(vertices=" ".join(map(str, VERTICES.ravel()))))


def judged(*heights, ignored=("thing",)):
    """The judge after the link was at each of `heights`, between a table at 0 and a thing at 1.9."""
    judge, data = ContactJudge(MODEL, first="link", robot="stand", ignored=ignored), mujoco.MjData(MODEL)
    for height in heights:
        data.qpos[0] = height
        judge.update(data)
    return judge


def test_the_judge_sees_meshes_that_do_not_collide_in_the_suite_and_measures_their_depth():
    assert judged(0.5, 0.11).depth == {}
    found = judged(0.5, 0.08, 0.07, 0.5)
    assert found.depth == {"link and table": pytest.approx(0.03, abs=1e-3)}
    assert found.time == {"link and table": pytest.approx(2 * MODEL.opt.timestep)}
    assert judged(0.5, 1.95).depth == {}
    assert list(judged(0.5, 1.95, ignored=()).depth) == ["link and thing"]
    assert MODEL.geom_contype[-1] == 0, "the model of the suite is not changed"


def test_an_overlap_at_the_start_counts_only_after_the_pair_was_apart():
    found = judged(0.08, 0.07)
    assert found.at_start == {"link and table"}
    assert found.depth == {}
    assert judged(0.08, 0.5, 0.09).depth == {"link and table": pytest.approx(0.01, abs=1e-3)}


def test_every_mode_has_the_same_tasks_policies_and_seeds(tmp_path):
    units = MocapGuard().units(Options(folder=tmp_path, planner=""))
    assert len({unit.key for unit in units}) == len(units)
    per_batch = SEEDS_PER_BATCH * sum(len(modes(suite, policy)) for suite in TASKS.values() for policy in POLICIES)
    batch = [unit.parameters for unit in units[:per_batch]]
    found = {
        mode: {(one["task"], one["policy"], one["seed"]) for one in batch if one["mode"] == mode}
        for mode in ("unguarded", "guarded")
    }
    assert found["guarded"] == found["unguarded"]
    assert len(found["guarded"]) == len(TASKS) * len(POLICIES) * SEEDS_PER_BATCH
    assert {one["mode"] for one in batch} == {"unguarded", "guarded", *OPTION_MODES.values()}


def test_each_suite_has_a_virtual_environment_of_its_own_with_pinned_packages():
    folders = {environment.folder for environment in ENVIRONMENTS.values()}
    assert set(ENVIRONMENTS) == set(TASKS.values())
    assert len(folders) == len(ENVIRONMENTS)
    assert all("==" in package for environment in ENVIRONMENTS.values() for package in environment.packages)


PLACES = {"tool": np.zeros(3), "object": np.array([0.1, 0.0, 0.0]), "goal": np.array([0.2, 0.4, 0.1])}


def test_careless_policies_move_at_full_speed_toward_what_they_aim_at():
    np.testing.assert_allclose(Straight(has_object=False)(PLACES, None), [0.5, 1.0, 0.25, 0.0])
    straight = Straight(has_object=True)
    np.testing.assert_allclose(straight(PLACES, None), [1.0, 0.0, 0.0, 0.0])
    near = PLACES | {"tool": np.array([0.09, 0.0, 0.0])}
    straight(near, None)
    assert straight(near, None)[1] == 1.0, "then to the goal"
    np.testing.assert_allclose(Low()(PLACES, None), [0.5, 1.0, -1.0, 0.0])
    one, same, other = (RandomPolicy(seed) for seed in (1, 1, 2))
    drawn = [[policy(PLACES, None).tolist() for _ in range(60)] for policy in (one, same, other)]
    assert drawn[0] == drawn[1] != drawn[2]


def move(task, steps=200):
    """The places after a script has moved a tool that follows at once, and an object in its closed hand."""
    places, held = (
        {"tool": np.array([0.0, 0.0, 0.6])} | {k: PLACES[k] + [0.0, 0.0, 0.4] for k in ("object", "goal")},
        False,
    )
    policy = make_policy("careful", task, 0, None)
    for _ in range(steps):
        action = policy(places, None)
        assert np.abs(action).max() <= 1.0
        held |= action[3] < 0.0 and bool(np.linalg.norm(places["tool"] - places["object"]) < 0.03)
        shift = 0.05 * action[:3]
        places = places | {"tool": places["tool"] + shift}
        if held and task == "FetchPickAndPlace":
            places = places | {"object": places["object"] + shift}
    return places


@pytest.mark.parametrize(("task", "arrives"), [("FetchReach", "tool"), ("FetchPickAndPlace", "object")])
def test_a_careful_script_reaches_its_goal(task, arrives):
    places = move(task)
    assert np.linalg.norm(places[arrives] - places["goal"]) < 0.02


def row(mode, policy="careful", **changes):
    found = {
        "key": f"FetchReach {policy} {mode} 7",
        "suite": "fetch",
        "task": "FetchReach",
        "policy": policy,
        "mode": mode,
        "seed": 7,
        "start": {"tool": [0.0, 0.0, 0.0]},
        "end": {"tool": [0.0, 0.0, 0.0], "goal": [0.0, 0.0, 0.05]},
        "steps": 10,
        "success": 10,
        "time": 0.4,
        "depth": {},
        "versions": {"mujoco": "3.11.0"},
    }
    if mode != "unguarded":
        found |= {"deviation": 0.011, "arm_deviation": 0.02, "status": {"SAFE": 8, "MODIFIED": 2}, "stops": 1}
        found |= {"h_min": 0.002, "filter_ms": [3.0, 8.0], "last": "passed unchanged"}
    return found | changes


def report(*rows):
    return "\n".join(MocapGuard().report(list(rows)))


def test_the_tables_show_pairs_contacts_and_lost_successes():
    touched = {"hand and table": 0.0035}
    text = report(row("unguarded", depth=touched, time=0.2), row("guarded"))
    assert "3.5 mm" in text
    assert "2.0 times" in text
    assert "11 / 20 mm" in text
    assert "starts that differ: 0" in text
    assert "No guarded episode had a contact" in text
    for change in ({"depth": touched}, {"success": 0}):
        assert "| FetchReach careful guarded 7 |" in report(row("unguarded"), row("guarded", **change)), change
    assert "No guarded episode had a contact" in report(row("unguarded", success=0), row("guarded", success=0))
    assert "starts that differ: 1" in report(row("unguarded"), row("guarded", start={"tool": [1.0, 0.0, 0.0]}))


def test_a_row_is_summarized_with_its_contacts():
    assert MocapGuard().summarize_row(row("guarded")) == "success after 10 steps; no contact"
    assert "hand and table 3.5 mm" in MocapGuard().summarize_row(row("guarded", depth={"hand and table": 0.0035}))
