"""The scene summary: symbols without numbers, invariant to small motions and rotations, different where it matters."""

import re

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Pose
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.records import Place
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.generators.tabletop import SINGLE_GOAL_FAMILIES
from tests.grounding.perceived_scenes import bowl, box, forearm, rotate_scene, scene

CUBE = box("red_cube", 0.5, -0.2)
CAN = ("green_can", (0.02, 0.02, 0.05))


def line(text, name):
    return next(row for row in text.splitlines() if row.startswith(f"{name}:"))


def beside(dx, dy, half=(0.02, 0.02, 0.05)):
    return summarise_scene(scene(CUBE, bowl(), box("green_can", 0.5 + dx, -0.2 + dy, half)))


@given(dx=st.floats(-0.001, 0.001), dy=st.floats(-0.001, 0.001), dz=st.floats(-0.0005, 0.0005))
@pytest.mark.parametrize("gap", [0.015, 0.045])
def test_a_small_motion_away_from_class_boundaries_changes_nothing(gap, dx, dy, dz):
    distance = 0.02 + gap + np.hypot(0.02, 0.02)
    expected = beside(distance, 0.0)
    moved = scene(CUBE, bowl(), box("green_can", 0.5 + distance + dx, -0.2 + dy, (0.02, 0.02, 0.05 + dz)))
    assert summarise_scene(moved) == expected


@given(yaw=st.floats(-0.35, 0.35), seed=st.integers(0, 200))
def test_rotating_the_whole_scene_about_z_changes_nothing(yaw, seed):
    rng = np.random.default_rng(seed)
    objects = [box("red_cube", 0.5, -0.2, yaw=rng.uniform(-3, 3)), bowl(0.5, 0.2)]
    half = (0.02, 0.02, float(rng.uniform(0.03, 0.11)))
    objects.append(box("green_can", 0.5 + rng.uniform(-0.1, 0.1), -0.05 + rng.uniform(-0.03, 0.1), half))
    objects.append(forearm(0.5, 0.1, (0.0, float(rng.choice([0.0, 0.15])), 0.0)))
    one = scene(*objects)
    assert summarise_scene(rotate_scene(one, yaw)) == summarise_scene(one)


@given(shift=st.floats(-0.02, 0.02), seed=st.integers(0, 50))
def test_a_small_shift_of_the_whole_scene_changes_nothing(shift, seed):
    rng = np.random.default_rng(seed)
    cube, can = (0.5, -0.2), (0.5 + rng.uniform(0.07, 0.1), -0.2)
    one = scene(box("red_cube", *cube), bowl(), box("green_can", *can))
    other = scene(
        box("red_cube", cube[0] + shift, cube[1]), bowl(0.5 + shift), box("green_can", can[0] + shift, can[1])
    )
    assert summarise_scene(one) == summarise_scene(other)


@pytest.mark.parametrize("family", SINGLE_GOAL_FAMILIES)
@pytest.mark.parametrize("seed", range(3))
def test_the_summary_contains_no_numbers(family, seed):
    """Quantities appear as classes; the only digits are those of class names."""
    text = summarise_scene(scene_from_spec(open_scene(f"{family}:{seed}")))
    bare = re.sub(r"[<>]?\d(-\d)?cm", "", text)
    assert not re.search(r"\d", bare), text


@pytest.mark.parametrize("family", SINGLE_GOAL_FAMILIES)
def test_the_summary_does_not_depend_on_stamps_errors_and_colours(family):
    one = scene_from_spec(open_scene(f"{family}:1"))
    objects = tuple(
        msgspec.structs.replace(t, stamp=9.0, error=0.009, velocity_error=0.01, colour="", category="")
        for t in one.objects
    )
    assert summarise_scene(msgspec.structs.replace(one, stamp=9.0, version=7, objects=objects)) == summarise_scene(one)


def test_a_neighbour_appears_on_its_axis_with_its_class():
    near, far, tall = beside(0.065, 0.0), beside(0.3, 0.0), beside(0.065, 0.0, (0.02, 0.02, 0.12))
    assert "neighbour_along" in line(near, "red_cube")
    assert "neighbour_across" in line(beside(0.0, 0.065), "red_cube")
    assert "neighbour_" not in line(far, "red_cube")
    assert "tall" in line(tall, "red_cube")
    assert near != tall


def test_the_free_finger_axis():
    assert "free_finger_axis across" in line(beside(0.065, 0.0), "red_cube")
    assert "free_finger_axis along" in line(beside(0.0, 0.065), "red_cube")


def test_obstacles_on_and_above_the_path():
    assert "tall" in line(summarise_scene(scene(CUBE, bowl(), box("wall", 0.5, 0.03, (0.02, 0.02, 0.12)))), "red_cube")
    board = box("shelf", 0.5, 0.05, (0.1, 0.03, 0.01), "obstacle", z=0.45)
    assert "overhead" in line(summarise_scene(scene(CUBE, bowl(), board)), "red_cube")
    elsewhere = box("shelf", 0.5, -0.6, (0.1, 0.03, 0.01), "obstacle", z=0.45)
    assert "overhead" not in line(summarise_scene(scene(CUBE, bowl(), elsewhere)), "red_cube")


def test_people_fragile_objects_and_edges():
    assert "person: none" in summarise_scene(scene(CUBE, bowl()))
    assert "person: near" in summarise_scene(scene(CUBE, bowl(), forearm(0.5, 0.1)))
    assert "person: crossing" in summarise_scene(scene(CUBE, bowl(), forearm(0.5, 0.1, (0.0, 0.15, 0.0))))
    assert "fragile" in line(summarise_scene(scene(box("red_cube", 0.5, -0.2, fragile_limit=15.0))), "red_cube")
    assert "near_edge" in line(summarise_scene(scene(box("red_cube", 0.4, -0.64))), "red_cube")
    assert "near_edge" not in summarise_scene(scene(CUBE, bowl()))


def test_the_held_object_and_the_places():
    text = summarise_scene(scene(CUBE, bowl(), places=[("table_left", (0.36, 0.46, 0.0))]), "red_cube")
    assert "holding red_cube" in text
    assert "table_left" in text
    assert "holding nothing" in summarise_scene(scene(CUBE))


def test_an_empty_scene_has_a_summary():
    assert "person: none" in summarise_scene(scene())


def test_a_scene_with_two_objects_at_one_position_has_a_summary():
    twin = msgspec.structs.replace(CUBE, name="twin", pose=Pose(CUBE.pose.position))
    assert line(summarise_scene(scene(CUBE, twin, bowl())), "twin")


def test_without_a_container_the_path_leads_to_the_only_place():
    tall = box("wall", 0.5, 0.03, (0.02, 0.02, 0.12))
    coaster, other = Place("coaster", (0.5, 0.26, 0.0)), Place("shelf", (0.3, -0.3, 0.0))
    one = msgspec.structs.replace(scene(CUBE, tall), places=(coaster,))
    assert "path_max_height tall" in line(summarise_scene(one), "red_cube")
    assert "path" not in summarise_scene(msgspec.structs.replace(one, places=(coaster, other)))


def test_an_aisle_is_free_narrow_or_occupied():
    for seed in range(6):
        spec = open_scene(f"aisles:{seed}", "base")
        plant = make_plant(spec, load_robot("base"))
        text = summarise_scene(NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant))
        parcels = "left" if spec.find("brown_parcel_1").position[1] > 0.0 else "right"
        assert f"aisle_{parcels} narrow" in text
        other = "right" if parcels == "left" else "left"
        assert f"aisle_{other} {('occupied', 'free', 'occupied')[seed % 3]}" in text
    assert "aisle" not in summarise_scene(scene_from_spec(open_scene("crossing:1", "base")))


def test_the_summary_of_a_workroom_contains_places_and_headings():
    for family, seed in (("workroom", 0), ("workroom", 4), ("busy_workroom", 1)):
        spec = open_scene(f"{family}:{seed}", "mobile_panda")
        text = summarise_scene(scene_from_spec(spec))
        side = np.sign(spec.find_place("bench").position[1])
        assert line(text, "bench") == f"bench: before table, heading {side * np.pi / 2:.2f}"
        assert line(text, "red_cube").startswith("red_cube: object, at bench, free_finger_axis")
        assert line(text, "blue_bowl") == "blue_bowl: container, at bench"
        assert "places: shelf, charger, bench" in text
        assert "near_edge" not in text


def test_heights_and_edges_of_objects_on_furniture_are_relative_to_it():
    table = box("table", 1.0, 0.0, (0.3, 0.4, 0.3), role="support")
    cube, can = (
        box(name, 1.0, y, half, z=0.6 + half[2])
        for name, y, half in (
            ("red_cube", 0.0, (0.02, 0.02, 0.02)),
            ("green_can", 0.08, (0.02, 0.02, 0.05)),
        )
    )
    room = msgspec.structs.replace(
        scene(cube, can),
        objects=(table, cube, can),
        region=((-1.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-1.0, 2.0)),
        places=(Place("desk", (0.2, 0.0, 0.0)), Place("exit", (-0.8, 0.0, 0.0))),
    )
    text = summarise_scene(room)
    assert line(text, "desk") == "desk: before table, heading 0.00"
    assert "hand_high" in line(text, "red_cube")
    assert "near_edge" not in text
    at_edge = msgspec.structs.replace(cube, pose=Pose((0.72, 0.0, 0.62)))
    moved = msgspec.structs.replace(room, objects=(table, at_edge, can))
    assert "near_edge" in line(summarise_scene(moved), "red_cube")
    fallen = msgspec.structs.replace(cube, pose=Pose((0.4, 0.5, 0.02)))
    assert ", at desk" not in line(summarise_scene(msgspec.structs.replace(room, objects=(table, fallen))), "red_cube")
