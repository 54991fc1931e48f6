"""Foresight: distances against sampling, what counts, and where a rehearsal may be broken off."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills.arm.controller import ToolGoal
from dualbrain.skills.kinematics.clearance_prediction import (
    KNOWN_OBJECT_ALLOWANCE,
    STEP_LENGTH,
    ClearancePredictor,
    PredictionContext,
)
from dualbrain.skills.skill import PermittedContact
from dualbrain.skills.time_slicing import run_to_completion

BODY = load_robot("panda")
SAFETY = SafetyFilter(BODY)
HOME = home_state(BODY).q
size = st.floats(0.01, 0.2)
solids = st.one_of(st.builds(Sphere, size), st.builds(Capsule, size, size), st.builds(Box, st.tuples(size, size, size)))

poses = st.builds(
    lambda p, q: Pose(p, tuple(np.array(q) / np.linalg.norm(q))),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)


def seen(shape, pose=None, name="thing", role="object", error=0.0):
    return SceneObject(name=name, role=role, shape=shape, pose=pose or Pose((0.0, 0.0, 0.0)), error=error)


def scene(*things):
    return Scene(robot="panda", stamp=0.0, version=1, objects=things)


def room(*things, points=(), leaving=0, beat=-np.inf, **others):
    view = PredictionContext(opening=0.02, scene=scene(*things), **others)
    return run_to_completion(
        ClearancePredictor(BODY, SAFETY).min_clearance(HOME, points, view, ignored_steps=leaving, threshold=beat)
    )


@settings(max_examples=40)
@given(solids, poses)
def test_a_distance_is_that_to_the_nearest_surface_point(shape, pose):
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.0, 1.0, (20, 3))
    local = (points - pose.position) @ quaternion_to_matrix(pose.quaternion)
    radius = 0.0
    match shape:
        case Sphere(radius):
            inside = np.zeros_like(local)
        case Capsule(radius, half):
            inside = np.column_stack([0 * local[:, :2], np.clip(local[:, 2], -half, half)])
        case Box(core):
            inside = np.clip(local, -np.array(core), core)
    outside = np.linalg.norm(local - inside, axis=1) - radius
    got = signed_distance(shape, pose, points)
    assert np.allclose(got[outside > 0], outside[outside > 0])
    assert np.all(got[outside <= 0] <= 1e-12)


def test_the_least_room_is_that_of_the_nearest_sphere():
    centres, radii, _ = SAFETY.spheres(HOME, 0.02)
    post = Pose((0.55, 0.3, 0.4))
    away = np.linalg.norm(centres[3:] - post.position, axis=1) - radii[3:] - 0.05
    assert room(seen(Sphere(0.05), post, error=0.01)) == pytest.approx(away.min() - 0.01)


def test_people_the_held_thing_and_the_bolted_base_do_not_count():
    at = Pose(tuple(SAFETY.tool(HOME).position))
    far = seen(Sphere(0.01), Pose((0.0, 2.0, 0.0)))
    assert room(seen(Sphere(0.1), at, role="person"), far) == room(far)
    assert room(seen(Sphere(0.1), at, "cube"), far, held="cube") == room(far)
    assert room(seen(HalfSpace(), name="table", role="support")) > 0.0


def test_a_part_may_touch_what_its_phase_needs():
    tool = SAFETY.tool(HOME).position
    cube = seen(Box((0.02, 0.02, 0.02)), Pose(tuple(tool)))
    spared = room(cube, touches=(PermittedContact("fingers", "thing", 0.05),))
    assert room(cube) < 0.0
    assert spared > 0.005
    assert room(cube, touches=(PermittedContact("fingers", "other", 0.05),)) == room(cube)
    assert room(cube, known=("thing",)) == pytest.approx(room(cube) + KNOWN_OBJECT_ALLOWANCE)


def test_a_way_leads_there_in_small_steps():
    tool = SAFETY.tool(HOME)
    aim = ToolGoal(tool.position + np.array([0.05, 0.25, -0.1]), tool.rotation, HOME)
    way = list(ClearancePredictor(BODY, SAFETY).simulate_path(HOME, [aim]))
    places = np.array([SAFETY.tool(q).position for q in way])
    assert np.linalg.norm(places[-1] - aim.position) < 0.004
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.02


def test_a_wall_on_the_way_is_foreseen():
    tool = SAFETY.tool(HOME)
    wall = seen(Box((0.2, 0.01, 0.3)), Pose((0.5, 0.25, 0.3)))
    aim = ToolGoal(tool.position + np.array([0.0, 0.4, 0.0]), tool.rotation, HOME)
    start, end = room(wall), room(wall, points=[aim])
    assert start > 0.05
    assert end < 0.0


def somewhere(rng):
    """A goal about the arm's first pose, and things about its way."""
    tool = SAFETY.tool(HOME)
    aim = ToolGoal(tool.position + rng.uniform(-0.3, 0.3, 3) * (0.5, 1.0, 0.5), tool.rotation, HOME)
    middle = (tool.position + aim.position) / 2
    return aim, [seen(Sphere(0.03), Pose(tuple(middle + rng.normal(0.0, 0.15, 3))), f"ball{k}") for k in range(4)]


@pytest.mark.parametrize("seed", range(8))
def test_a_way_has_the_room_of_its_nearest_posture(seed):
    """Whatever is looked at together, or not at all because it is far away."""
    aim, things = somewhere(np.random.default_rng(seed))
    foresight = ClearancePredictor(BODY, SAFETY)
    view = PredictionContext(opening=0.02, scene=scene(*things))
    each = [run_to_completion(foresight.min_clearance(q, [], view)) for q in foresight.simulate_path(HOME, [aim])]
    assert room(*things, points=[aim]) == pytest.approx(min(each))
    for leaving in (3, len(each) + 5):
        assert room(*things, points=[aim], leaving=leaving) == pytest.approx(min(each[leaving:] or each[-1:]))


@pytest.mark.parametrize("seed", range(8))
def test_a_rehearsal_is_broken_off_only_where_it_cannot_win(seed):
    aim, things = somewhere(np.random.default_rng(seed))
    whole = room(*things, points=[aim])
    for beat in (whole - 0.01, whole + 0.01):
        cut = room(*things, points=[aim], beat=beat)
        assert cut == whole if whole > beat else cut <= beat


def test_a_stride_is_no_longer_than_it_says():
    aim, _ = somewhere(np.random.default_rng(1))
    way = ClearancePredictor(BODY, SAFETY).simulate_path(HOME, [aim])
    places = np.array([SAFETY.tool(q).position for q in way])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 1.1 * STEP_LENGTH
