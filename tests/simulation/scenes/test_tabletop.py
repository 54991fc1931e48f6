"""Scenes: same seed same scene, nothing overlaps, JSON goes round, and broken files say what is wrong."""

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
def test_scenes_repeat_and_go_through_json(family, seed):
    spec = make_scene(family, seed)
    assert spec == make_scene(family, seed)
    assert msgspec.json.decode(msgspec.json.encode(spec), type=type(spec)) == spec


@given(families, seeds)
@settings(max_examples=150, deadline=None)
def test_things_stand_apart_and_places_are_free(family, seed):
    spec = make_scene(family, seed)
    names = [thing.name for thing in spec.objects]
    assert len(set(names)) == len(names)
    standing = [thing for thing in spec.objects if not thing.fixed]
    for index, one in enumerate(standing):
        for other in standing[:index]:
            gap = np.hypot(one.position[0] - other.position[0], one.position[1] - other.position[1])
            assert gap > inner(one) + inner(other) + 0.015
        for place in spec.places:
            assert np.hypot(one.position[0] - place.position[0], one.position[1] - place.position[1]) > 0.10


def inner(thing):
    """Radius of the largest upright circle inside a shape."""
    return min(thing.shape.half_extents[:2]) if isinstance(thing.shape, Box) else thing.shape.radius


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


def test_families_vary_inside():
    """Side and height of the neighbour, the shelf and the person's phase differ from seed to seed."""
    sides, shelves, phases = set(), set(), set()
    for seed in range(20):
        tall, shelf, arm = make_scene("tall", seed), make_scene("shelf", seed), make_scene("forearm", seed)
        delta = np.subtract(tall.objects[2].position, tall.objects[0].position)
        sides.add(int(np.round(np.arctan2(delta[1], delta[0]) / (np.pi / 2))) % 4)
        shelves.add(any(thing.name == "shelf" for thing in shelf.objects))
        phases.add(round(arm.mover.phase))
    assert sides == {0, 1, 2, 3}
    assert shelves == {True, False}
    assert len(phases) > 6


@given(st.sampled_from(["tabletop", "tall", "shelf", "forearm", "fragile"]), seeds)
@settings(max_examples=80, deadline=None)
def test_narrow_gaps_only_beside_low_things(family, seed):
    spec = make_scene(family, seed)
    cube = spec.objects[0]
    yaw = 2.0 * np.arctan2(cube.quaternion[3], cube.quaternion[0])
    for thing in spec.objects[2:]:
        if thing.fixed:
            continue
        delta = np.subtract(thing.position, cube.position)[:2]
        local = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) @ delta
        half = thing.shape.radius if isinstance(thing.shape, Cylinder) else max(thing.shape.half_extents[:2])
        gap = np.abs(local).max() - 0.02 - half
        height = 2 * thing.position[2]
        assert gap > (0.009 if height < 0.07 else 0.025)


def test_an_unknown_family_names_the_known_ones():
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
def test_a_broken_file_says_what_is_wrong(case, tmp_path):
    break_it, says = BROKEN[case]
    data = json.loads(msgspec.json.encode(make_scene("forearm", 0)))
    break_it(data)
    (tmp_path / "s.json").write_text("{" if case == "no JSON" else json.dumps(data))
    with pytest.raises(ConfigurationError, match=says):
        load_scene(tmp_path / "s.json")


def test_a_missing_file_says_so(tmp_path):
    with pytest.raises(ConfigurationError, match="No such file"):
        load_scene(tmp_path / "absent.json")


def owner(p, geom):
    return p.model.body(p.model.geom_bodyid[geom]).name
