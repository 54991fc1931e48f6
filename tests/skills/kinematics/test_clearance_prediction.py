"""Predicted clearances: distances against sampling, which objects count, and when the computation may stop early."""

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


def perceived(shape, pose=None, name="object", role="object", error=0.0):
    return SceneObject(name=name, role=role, shape=shape, pose=pose or Pose((0.0, 0.0, 0.0)), error=error)


def scene(*objects):
    return Scene(robot="panda", stamp=0.0, version=1, objects=objects)


def clearance(*objects, waypoints=(), ignored_steps=0, threshold=-np.inf, **others):
    context = PredictionContext(opening=0.02, scene=scene(*objects), **others)
    computation = ClearancePredictor(BODY, SAFETY).min_clearance(
        HOME, waypoints, context, ignored_steps=ignored_steps, threshold=threshold
    )
    return run_to_completion(computation)


@settings(max_examples=40)
@given(solids, poses)
def test_the_signed_distance_is_that_to_the_nearest_surface_point(shape, pose):
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


def test_the_clearance_is_that_of_the_nearest_sphere():
    centres, radii, _ = SAFETY.spheres(HOME, 0.02)
    pose = Pose((0.55, 0.3, 0.4))
    distances = np.linalg.norm(centres[3:] - pose.position, axis=1) - radii[3:] - 0.05
    assert clearance(perceived(Sphere(0.05), pose, error=0.01)) == pytest.approx(distances.min() - 0.01)


def test_people_the_held_object_and_the_fixed_base_do_not_count():
    at_the_tool = Pose(tuple(SAFETY.tool(HOME).position))
    far = perceived(Sphere(0.01), Pose((0.0, 2.0, 0.0)))
    assert clearance(perceived(Sphere(0.1), at_the_tool, role="person"), far) == clearance(far)
    assert clearance(perceived(Sphere(0.1), at_the_tool, "cube"), far, held="cube") == clearance(far)
    assert clearance(perceived(HalfSpace(), name="table", role="support")) > 0.0


def test_a_permitted_contact_of_the_phase_counts_less():
    tool = SAFETY.tool(HOME).position
    cube = perceived(Box((0.02, 0.02, 0.02)), Pose(tuple(tool)), "cube")
    permitted = clearance(cube, contacts=(PermittedContact("fingers", "cube", 0.05),))
    assert clearance(cube) < 0.0
    assert permitted > 0.005
    assert clearance(cube, contacts=(PermittedContact("fingers", "other", 0.05),)) == clearance(cube)
    assert clearance(cube, known=("cube",)) == pytest.approx(clearance(cube) + KNOWN_OBJECT_ALLOWANCE)


def test_a_simulated_path_reaches_its_goal_in_small_steps():
    tool = SAFETY.tool(HOME)
    goal = ToolGoal(tool.position + np.array([0.05, 0.25, -0.1]), tool.rotation, HOME)
    path = list(ClearancePredictor(BODY, SAFETY).simulate_path(HOME, [goal]))
    positions = np.array([SAFETY.tool(q).position for q in path])
    assert np.linalg.norm(positions[-1] - goal.position) < 0.004
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.02


def test_a_wall_on_the_path_is_predicted():
    tool = SAFETY.tool(HOME)
    wall = perceived(Box((0.2, 0.01, 0.3)), Pose((0.5, 0.25, 0.3)))
    goal = ToolGoal(tool.position + np.array([0.0, 0.4, 0.0]), tool.rotation, HOME)
    start, end = clearance(wall), clearance(wall, waypoints=[goal])
    assert start > 0.05
    assert end < 0.0


def random_problem(rng):
    """A goal near the home pose of the arm, and spheres around the path to the goal."""
    tool = SAFETY.tool(HOME)
    goal = ToolGoal(tool.position + rng.uniform(-0.3, 0.3, 3) * (0.5, 1.0, 0.5), tool.rotation, HOME)
    middle = (tool.position + goal.position) / 2
    spheres = [perceived(Sphere(0.03), Pose(tuple(middle + rng.normal(0.0, 0.15, 3))), f"sphere{k}") for k in range(4)]
    return goal, spheres


@pytest.mark.parametrize("seed", range(8))
def test_the_clearance_of_a_path_is_that_of_its_nearest_posture(seed):
    """Neither batches of postures nor the omission of far objects change the result."""
    goal, objects = random_problem(np.random.default_rng(seed))
    predictor = ClearancePredictor(BODY, SAFETY)
    context = PredictionContext(opening=0.02, scene=scene(*objects))
    path = predictor.simulate_path(HOME, [goal])
    each = [run_to_completion(predictor.min_clearance(q, [], context)) for q in path]
    assert clearance(*objects, waypoints=[goal]) == pytest.approx(min(each))
    for ignored in (3, len(each) + 5):
        expected = min(each[ignored:] or each[-1:])
        assert clearance(*objects, waypoints=[goal], ignored_steps=ignored) == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(8))
def test_the_computation_stops_early_only_below_the_threshold(seed):
    goal, objects = random_problem(np.random.default_rng(seed))
    complete = clearance(*objects, waypoints=[goal])
    for threshold in (complete - 0.01, complete + 0.01):
        found = clearance(*objects, waypoints=[goal], threshold=threshold)
        assert found == complete if complete > threshold else found <= threshold


def test_steps_of_a_simulated_path_are_at_most_the_step_length():
    goal, _ = random_problem(np.random.default_rng(1))
    path = ClearancePredictor(BODY, SAFETY).simulate_path(HOME, [goal])
    positions = np.array([SAFETY.tool(q).position for q in path])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 1.1 * STEP_LENGTH
