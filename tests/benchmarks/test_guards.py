"""The benchmark of guards: scenes, paths, the interface of the arm, and each guard that needs no other environment."""

import numpy as np
import pytest

from benchmarks.guards import tables
from benchmarks.guards.depth_obstacles import DepthObstacles
from benchmarks.guards.episode import GUARDS, run_episode
from benchmarks.guards.guards.guard import TargetGuard
from benchmarks.guards.guards.path_braking import PathBraking
from benchmarks.guards.guards.relative_clamp import MAX_RELATIVE_TARGET, RelativeClamp
from benchmarks.guards.guards.robot_dam.guard import HAND_RADIUS, keep_out_spheres
from benchmarks.guards.learned_policy import describe_obstacles
from benchmarks.guards.path_planning import RESOLUTION, JointRange, edge_points, find_path
from benchmarks.guards.policies import PERIOD, CarefulPolicy, CarelessPolicy, RandomPolicy, speed_limits
from benchmarks.guards.policy_guards import PolicyGuards
from benchmarks.guards.robot_interface import RobotInterface
from benchmarks.guards.scene import PATH_CLEARANCE, is_clear, load_panda, make_scene
from dualbrain.core.geometry.shapes import Box, Capsule, Pose, Sphere
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.safety.reference_judge import rotation_matrix
from tests.safety import geometry_oracle
from tests.simulation.perception.test_rendering import run_program

PANDA, _ = load_panda()
SQUARE = JointRange(np.full(2, -1.0), np.full(2, 1.0))
BLOCKED = 3
"""A scene in which the straight way to the goal is not free."""

WITH_CAMERAS = f"""
from benchmarks.guards.depth_obstacles import run_with_cameras
from benchmarks.guards.scene import make_scene
found = run_with_cameras(make_scene({BLOCKED}), "careless", unknown_is_occupied=False, duration=1.0)
assert not found["contact"], found
assert found["images"] >= 3 * 10, found
assert 0 < found["boxes"] <= 48, found
"""


@pytest.fixture(scope="module")
def scene():
    return make_scene(BLOCKED)


def test_a_path_leads_around_a_wall_and_every_edge_is_free():
    def is_free(q):
        return ~((np.abs(q[:, 0]) < 0.1) & (q[:, 1] < 0.7))

    path = find_path(is_free, SQUARE, np.array([-0.8, -0.5]), np.array([0.8, -0.5]), np.random.default_rng(1))
    np.testing.assert_allclose(path[[0, -1]], [[-0.8, -0.5], [0.8, -0.5]])
    assert is_free(path).all()
    assert np.abs(np.diff(path, axis=0)).max() <= RESOLUTION + 1e-12
    assert path[:, 1].max() >= 0.7


def test_without_a_way_there_is_no_path():
    path = find_path(lambda q: np.abs(q[:, 0]) > 0.1, SQUARE, np.array([-0.8, 0.0]), np.array([0.8, 0.0]), rng())
    assert path is None


def rng():
    return np.random.default_rng(0)


def test_a_scene_has_a_clear_path_and_an_odd_one_no_straight_way(scene):
    _, judge = load_panda()
    assert is_clear(judge, scene.path, scene.obstacles, PATH_CLEARANCE).all()
    np.testing.assert_allclose(scene.path[[0, -1]], [scene.start, scene.goal])
    h = np.minimum(
        geometry_oracle.h_obstacles(PANDA, scene.path, scene.obstacles, 0.04),
        geometry_oracle.h_self(PANDA, scene.path, 0.04),
    )
    assert h.min() > 0.0
    for seed in (1, 3, 5, 7, 9, 11):
        odd = make_scene(seed)
        assert not is_clear(judge, edge_points(odd.start, odd.goal), odd.obstacles, (0.0, 0.0, 0.0)).all()


def test_the_interface_keeps_the_limits_and_integrates_the_command():
    interface, random = RobotInterface(PANDA, np.array(PANDA.home)), rng()
    u = np.array([interface.limit(random.normal(0.0, 5.0, 7)) for _ in range(400)])
    assert np.all(np.abs(u) <= interface.v_max)
    assert np.all(np.abs(np.diff(u, axis=0)) <= interface.a_max * interface.period + 1e-12)
    np.testing.assert_allclose(interface.commanded, PANDA.home + u.sum(axis=0) * interface.period)


@pytest.mark.parametrize("policy", [CarefulPolicy, CarelessPolicy, RandomPolicy])
def test_a_policy_keeps_the_speed_limits(scene, policy):
    q, policy = scene.start.copy(), policy(scene, rng())
    for _ in range(200):
        target = policy.act(q)
        assert np.all(np.abs(target - q) <= PERIOD * speed_limits() + 1e-12)
        q = target
    if isinstance(policy, (CarefulPolicy, CarelessPolicy)):
        np.testing.assert_allclose(q, scene.goal, atol=1e-3)


def test_the_clamp_limits_each_joint_around_the_measured_posture():
    interface = RobotInterface(PANDA, np.array(PANDA.home))
    q, action = np.array(PANDA.home), np.array(PANDA.home) + np.array([0.5, -0.5, 0.01, 0.0, 0.0, 0.0, 0.0])
    moved = RelativeClamp(interface, PERIOD).safe_target(action, q) - q
    np.testing.assert_allclose(moved, [MAX_RELATIVE_TARGET, -MAX_RELATIVE_TARGET, 0.01, 0.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_path_braking_stops_before_a_wall_and_stays_on_the_line():
    start, wall = np.array(PANDA.home), PANDA.home[0] + 0.6
    interface = RobotInterface(PANDA, start)
    guard = PathBraking(interface, PERIOD, lambda q: q[:, 0] <= wall)
    for action in range(80):
        guard.begin(interface.commanded + np.array([0.03, 0.015, 0.0, 0.0, 0.0, 0.0, 0.0]), start, action * PERIOD)
        for step in range(20):
            interface.limit(guard.velocity(start, start, action * PERIOD + step * 1e-3))
            assert interface.commanded[0] <= wall
    moved = interface.commanded - start
    assert 0.5 < moved[0] <= 0.6
    assert moved[1] == pytest.approx(moved[0] / 2.0)
    assert np.abs(interface.u).max() == 0.0


@pytest.mark.parametrize(
    "shape", [Sphere(0.07), Capsule(0.05, 0.17), Box((0.13, 0.03, 0.08))], ids=["ball", "post", "box"]
)
def test_keep_out_spheres_cover_the_obstacle_and_the_extent_of_the_hand(shape):
    pose = Pose((0.4, 0.1, 0.3), (0.5, 0.5, 0.5, 0.5))
    spheres = np.array(keep_out_spheres(Obstacle("one", shape, pose)))
    match shape:
        case Box(half_extents=extents):
            points = rng().uniform(-1.0, 1.0, (500, 3)) * extents
        case _:
            points = rng().normal(size=(500, 3))
            points *= shape.radius / np.linalg.norm(points, axis=1, keepdims=True)
            points[:, 2] += rng().uniform(-1.0, 1.0, 500) * getattr(shape, "half_length", 0.0)
    points = points @ rotation_matrix(pose.quaternion).T + pose.position
    gaps = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
    assert gaps.min(axis=1).max() <= -HAND_RADIUS + 1e-9


def test_obstacles_are_described_by_their_extents_along_the_axes_of_the_world():
    lying = Obstacle("post", Capsule(0.05, 0.2), Pose((0.4, 0.0, 0.3), (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)))
    found = describe_obstacles((lying, lying)).reshape(-1, 6)
    np.testing.assert_allclose(found[0], [0.4, 0.0, 0.3, 0.25, 0.05, 0.05], atol=1e-12)
    assert not found[1:].any()


def test_a_careless_policy_hits_an_obstacle_unguarded_and_none_behind_the_whole_arm_guards(scene):
    rows = {guard: run_episode(scene, "careless", guard, 2.5) for guard in GUARDS if guard != "robot-dam"}
    assert rows["unguarded"]["contact"]
    assert rows["unguarded"]["min_scene_distance"] < -0.01
    for guard in ("path braking", "dualbrain", "dualbrain, along path"):
        assert not rows[guard]["contact"], guard
        assert min(rows[guard]["min_scene_distance"], rows[guard]["min_self_distance"]) > 0.0


def test_a_careful_policy_reaches_its_goal_unguarded_and_behind_dualbrain(scene):
    free, guarded = (run_episode(scene, "careful", guard) for guard in ("unguarded", "dualbrain"))
    assert not free["contact"]
    assert not guarded["contact"]
    assert guarded["reached"] == pytest.approx(free["reached"], abs=0.5)


def test_the_units_cover_every_policy_and_the_tables_count_safe_successes():
    benchmark = PolicyGuards()
    assert len(benchmark.units(None)) == 1000
    assert 2 * len(benchmark.units(None)) >= 2000, "episodes behind dualbrain"
    found = {"contact": False, "min_scene_distance": 0.1, "min_self_distance": 0.04, "action_us": [1e3, 2e3]}
    hit = {**found, "contact": True, "min_scene_distance": -0.01, "reached": 2.0}
    reached, missed = {**found, "reached": 2.0}, {**found, "reached": None}
    row = {"seed": 1, "policy": "careless", "guards": {guard: reached for guard in GUARDS} | {"unguarded": hit}}
    other = {"seed": 2, "policy": "careless", "guards": {guard: missed for guard in GUARDS} | {"unguarded": reached}}
    text = "\n".join(benchmark.report([row, other]))
    assert "Episodes behind dualbrain: **4**, with contact: **0**" in text
    assert "| unguarded | 2 | 1 of 2" in text
    dualbrain = next(line for line in text.splitlines() if line.startswith("| dualbrain |"))
    assert [cell.split(" (")[0] for cell in dualbrain.split(" | ")[1:]] == ["2", "0 of 2", "1 of 2", "1 of 1"]
    assert tables.is_safe_success(reached)
    assert not tables.is_safe_success(hit)
    assert not tables.is_safe_success(missed)


def test_depth_cameras_keep_a_careless_policy_free_of_contacts():
    code, output = run_program(WITH_CAMERAS, MUJOCO_GL="egl")
    if "MissingDependencyError" in output:
        code, output = run_program(WITH_CAMERAS, MUJOCO_GL="osmesa")
    assert code == 0, output


def test_the_tables_of_depth_cameras_count_contacts_by_source():
    found = {"contact": False, "min_scene_distance": 0.1, "min_self_distance": 0.04, "action_us": [1e3, 2e3]}
    seen = {**found, "reached": 2.0, "images": 30, "boxes": 48, "voxels": 300, "lost": 0.01, "image_ms": 60.0}
    hit = {**seen, "contact": True, "min_scene_distance": -0.01}
    sources = dict.fromkeys(("none", "known shapes", "depth cameras", "depth cameras, unknown occupied"), seen)
    rows = [{"seed": 1, "policy": "careless", "sources": sources}]
    rows.append({"seed": 2, "policy": "careless", "sources": sources | {"none": hit}})
    text = "\n".join(DepthObstacles().report(rows))
    assert "| none | 2 | 1 of 2" in text
    assert "| depth cameras | 2 | 0 of 2" in text
    assert "| depth cameras | 60 | 300 | 48 | 10 | 60 |" in text


def test_without_a_guard_every_target_is_executed():
    interface = RobotInterface(PANDA, np.array(PANDA.home))
    guard, target = TargetGuard(interface, PERIOD), np.array(PANDA.home) + 0.004
    guard.begin(target, np.array(PANDA.home), 0.0)
    np.testing.assert_allclose(guard.velocity(target, target, 0.0) * PERIOD, 0.004)
