"""Table scenes: reproducible, without overlap, saved and loaded as JSON; the errors of invalid files."""

import json

import msgspec
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Box, Cylinder
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.simulation.scenes.generators.tabletop import SINGLE_GOAL_FAMILIES, load_scene, make_scene, save_scene
from tests.simulation.scripted_hand import make_plant

families = st.sampled_from(sorted(SINGLE_GOAL_FAMILIES))
seeds = st.integers(0, 10**6)


@given(families, seeds)
@settings(max_examples=80, deadline=None)
def test_scenes_are_reproducible_and_can_be_stored_as_json(family, seed):
    spec = make_scene(family, seed)
    assert spec == make_scene(family, seed)
    assert msgspec.json.decode(msgspec.json.encode(spec), type=type(spec)) == spec


@given(families, seeds)
@settings(max_examples=150, deadline=None)
def test_objects_do_not_overlap_and_places_are_free(family, seed):
    spec = make_scene(family, seed)
    names = [obj.name for obj in spec.objects]
    assert len(set(names)) == len(names)
    standing = [obj for obj in spec.objects if not obj.fixed]
    for index, one in enumerate(standing):
        for other in standing[:index]:
            gap = np.hypot(one.position[0] - other.position[0], one.position[1] - other.position[1])
            assert gap > inscribed_radius(one) + inscribed_radius(other) + 0.015
        for place in spec.places:
            assert np.hypot(one.position[0] - place.position[0], one.position[1] - place.position[1]) > 0.10


def inscribed_radius(obj):
    """Radius of the largest circle inside the footprint of an object."""
    return min(obj.shape.half_extents[:2]) if isinstance(obj.shape, Box) else obj.shape.radius


@pytest.mark.parametrize("family", sorted(SINGLE_GOAL_FAMILIES))
def test_a_scene_starts_without_overlap_and_stays_at_rest(family):
    for seed in range(4):
        p = make_plant(family, seed)
        deep = [c.dist for c in p.data.contact if c.dist < -1e-4]
        assert not deep
        robot = [g for g in range(p.model.ngeom) if owner(p, g).startswith("robot/") and owner(p, g) != "robot/link0"]
        other = [
            g for g in range(p.model.ngeom) if not owner(p, g).startswith("robot/") and p.model.geom_conaffinity[g]
        ]
        nearest = min(mujoco.mj_geomDistance(p.model, p.data, a, b, 0.05, None) for a in robot for b in other)
        assert nearest > 0.01
        before = {name: np.array(p.true_pose(name).position) for name in p.object_names if name != "forearm"}
        for _ in range(400):
            p.advance()
        assert all(np.linalg.norm(np.array(p.true_pose(name).position) - at) < 1e-3 for name, at in before.items())


def test_scenes_of_a_family_vary():
    """The side of the neighbour, the shelf and the phase of the person differ between seeds."""
    sides, shelves, phases = set(), set(), set()
    for seed in range(20):
        tall, shelf, arm = make_scene("tall", seed), make_scene("shelf", seed), make_scene("forearm", seed)
        delta = np.subtract(tall.objects[2].position, tall.objects[0].position)
        sides.add(int(np.round(np.arctan2(delta[1], delta[0]) / (np.pi / 2))) % 4)
        shelves.add(any(obj.name == "shelf" for obj in shelf.objects))
        phases.add(round(arm.mover.phase))
    assert sides == {0, 1, 2, 3}
    assert shelves == {True, False}
    assert len(phases) > 6


@given(st.sampled_from(["tabletop", "tall", "shelf", "forearm", "fragile"]), seeds)
@settings(max_examples=80, deadline=None)
def test_narrow_gaps_only_beside_low_objects(family, seed):
    spec = make_scene(family, seed)
    cube = spec.objects[0]
    yaw = 2.0 * np.arctan2(cube.quaternion[3], cube.quaternion[0])
    for obj in spec.objects[2:]:
        if obj.fixed:
            continue
        delta = np.subtract(obj.position, cube.position)[:2]
        local = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) @ delta
        half = obj.shape.radius if isinstance(obj.shape, Cylinder) else max(obj.shape.half_extents[:2])
        gap = np.abs(local).max() - 0.02 - half
        height = 2 * obj.position[2]
        assert gap > (0.009 if height < 0.07 else 0.025)


def test_the_error_for_an_unknown_family_names_the_closest_one():
    with pytest.raises(UnknownNameError, match="Closest: 'tabletop'"):
        make_scene("tabeltop", 0)


def test_a_saved_scene_loads_again(tmp_path):
    spec = make_scene("forearm", 3)
    save_scene(spec, tmp_path / "scene.json")
    assert load_scene(tmp_path / "scene.json") == spec


BROKEN = {
    "no JSON": (lambda d: None, "truncated"),
    "unknown field": (lambda d: d.update(colour="red"), "colour"),
    "wrong type": (lambda d: d["things"][0].update(mass="heavy"), r"things\[0\].mass"),
    "unknown shape": (lambda d: d["things"][0]["shape"].update(shape="cone"), "cone"),
    "twice": (lambda d: d["things"].append(d["things"][0]), "red_cube"),
    "no mass": (lambda d: d["things"][0].update(mass=0.0), "mass and friction of red_cube"),
    "flat": (lambda d: d["things"][0]["shape"].update(half_extents=[0.02, 0.0, 0.02]), "size of red_cube"),
    "old": (lambda d: d.update(schema_version=0), "schema_version"),
    "stuck mover": (lambda d: d["mover"].update(speed=0.0), "path of forearm"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_the_error_for_an_invalid_file_names_the_problem(case, tmp_path):
    change, message = BROKEN[case]
    data = json.loads(msgspec.json.encode(make_scene("forearm", 0)))
    change(data)
    (tmp_path / "s.json").write_text("{" if case == "no JSON" else json.dumps(data))
    with pytest.raises(ConfigurationError, match=message):
        load_scene(tmp_path / "s.json")


def test_the_error_for_a_missing_file(tmp_path):
    with pytest.raises(ConfigurationError, match="There is no file"):
        load_scene(tmp_path / "absent.json")


def owner(p, geom):
    return p.model.body(p.model.geom_bodyid[geom]).name
