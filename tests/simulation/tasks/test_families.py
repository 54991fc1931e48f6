"""The five task families: reproducible scenes, instructions, a goal and a time limit for each robot and level."""

import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.scene_spec import check_scene
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.families import LEVELS, REQUEST_TYPES, TASK_FAMILIES, make_task, task_families_for

ROBOTS = ("panda", "ur5e", "base")
EVERY = [(robot, family, level) for robot in ROBOTS for family in task_families_for(robot) for level in LEVELS]


def test_the_families_are_the_five_of_the_paper():
    assert set(TASK_FAMILIES) == {
        "clutter_grasp",
        "edge_rescue",
        "dynamic_obstacle",
        "fragile_transfer",
        "mobile_navigation",
    }
    assert task_families_for("panda") == task_families_for("ur5e") == tuple(TASK_FAMILIES)[:4]
    assert task_families_for("base") == ("mobile_navigation",)


@pytest.mark.parametrize(("robot", "family", "level"), EVERY)
def test_equal_seeds_give_equal_tasks_and_different_seeds_different_scenes(robot, family, level):
    one, again, other = (make_task(family, level, seed, robot) for seed in (7, 7, 8))
    assert one == again
    assert one.spec != other.spec
    check_scene(one.spec)
    assert one.spec.robot == robot
    assert one.time_limit > 0.0


@pytest.mark.parametrize(("robot", "family", "level"), EVERY)
def test_the_goal_refers_to_objects_and_places_of_the_scene(robot, family, level):
    for seed in range(6):
        task = make_task(family, level, seed, robot)
        if isinstance(task.goal, ArrivalGoal):
            assert task.spec.find_place(task.goal.place)
            continue
        assert task.spec.find(task.goal.object_name).role == "object"
        names = [obj.name for obj in task.spec.objects if obj.role == "container"]
        assert task.goal.destination in [*names, *(place.name for place in task.spec.places)]


@pytest.mark.parametrize(("robot", "family", "level"), EVERY)
@pytest.mark.parametrize("request_type", REQUEST_TYPES)
def test_every_request_has_six_instructions_or_more_and_only_the_task_has_a_goal(robot, family, level, request_type):
    task = make_task(family, level, 3, robot, request_type)
    instructions = {task.instruction(index) for index in range(len(task.templates))}
    assert len(instructions) == len(task.templates) >= 6
    assert not any("{" in text or "_" in text for text in instructions)
    assert task.instruction(len(task.templates)) == task.instruction(0)
    assert task.label == ("possible" if request_type == "errand" else request_type)
    assert (task.goal is not None) is (request_type == "errand")


def test_consecutive_seeds_take_the_generators_in_turn():
    found = [make_task("clutter_grasp", "I", seed, "panda").spec for seed in range(6)]
    assert [spec.family for spec in found] == ["tabletop", "tall", "shelf"] * 2
    assert [spec.seed for spec in found] == [0, 0, 0, 1, 1, 1]


def test_both_arms_have_the_same_objects():
    one, other = (make_task("edge_rescue", "II", 5, robot).spec for robot in ("panda", "ur5e"))
    assert one.objects == other.objects


def test_unknown_names_are_rejected():
    with pytest.raises(UnknownNameError, match="mobile_navigation"):
        make_task("clutter_grasp", "I", 0, "base")
    with pytest.raises(UnknownNameError, match="level"):
        make_task("clutter_grasp", "III", 0, "panda")
    with pytest.raises(UnknownNameError, match="errand"):
        make_task("clutter_grasp", "I", 0, "panda", "nonsense")
