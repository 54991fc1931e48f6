"""The plant judge finds every contact that brute force finds; a short adversarial run holds with both drives."""

import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Sphere
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.stepped_plant import SteppedPlant
from dualbrain.simulation.scenes.scene_builder import ROBOT_PREFIX
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec
from experiments.safety.plant_adversary import IDENTIFIED_DRIVES, PlantAdversary, aggregate, run_episode
from experiments.safety.plant_judge import MAX_TOOL_REACH, PlantJudge


def fixed(name, shape, position):
    return ObjectSpec(
        name=name,
        role="obstacle",
        shape=shape,
        position=position,
        mass=1.0,
        colour="grey",
        category="obstacle",
        fixed=True,
    )


@pytest.fixture(scope="module")
def crowded():
    objects = (fixed("sphere", Sphere(0.08), (0.45, 0.25, 0.4)), fixed("crate", Box((0.1, 0.1, 0.2)), (0.5, -0.3, 0.2)))
    return SceneSpec(robot="panda", family="test", seed=0, objects=objects, places=())


def brute_force_distance(plant, judge):
    return min(mujoco.mj_geomDistance(plant.model, plant.data, a, b, 1.0, None) for a, b in judge._pairs.tolist())


def test_the_judge_counts_every_contact_of_an_unfiltered_arm(crowded):
    """Without filter and contacts: at every state the judge counts the same negative states as brute force."""
    plant = Plant(crowded, load_robot("panda"))
    robot, judge = SteppedPlant(plant, contacts=False), PlantJudge(plant)
    negative, u, u_nom = 0, np.zeros(7), np.array([0.5, 1.5, 0.0, 0.5, 0.0, 0.5, 0.0])
    for t in range(700):
        robot.measure()
        judge.update()
        truth = brute_force_distance(plant, judge) if t % 2 == 0 or judge.n_below_zero != negative else None
        if truth is not None and truth < 0.0:
            assert judge.n_below_zero > negative
            assert min(judge.min_scene_distance, judge.min_self_distance) <= truth
        negative = judge.n_below_zero
        u += np.clip(u_nom - u, -0.0075, 0.0075)
        robot.apply(u)
    assert negative > 0


def test_no_tool_point_exceeds_the_assumed_reach(crowded):
    plant = Plant(crowded, load_robot("panda"))
    mujoco.mj_forward(plant.model, plant.data)
    tip = plant.data.xanchor[6]
    for g in range(plant.model.ngeom):
        name = plant.model.body(int(plant.model.geom_bodyid[g])).name.removeprefix(ROBOT_PREFIX)
        if name in ("link7", "hand", "left_finger", "right_finger"):
            assert np.linalg.norm(plant.data.geom_xpos[g] - tip) + plant.model.geom_rbound[g] < MAX_TOOL_REACH


@pytest.mark.parametrize("kind", IDENTIFIED_DRIVES)
def test_short_runs_hold(kind):
    row = run_episode(kind, 1, 1500)
    assert row["below"] == row["below_spheres"] == row["below_joints"] == 0
    assert row["status"][3] == row["status"][4] == 0


def test_report_counts_both_drives():
    rows = [{"drive": kind, **aggregate([run_episode(kind, 0, 100)])} for kind in IDENTIFIED_DRIVES]
    text = "\n".join(PlantAdversary().report(rows))
    assert "**200**" in text
    assert all(kind in text for kind in IDENTIFIED_DRIVES)
