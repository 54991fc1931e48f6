"""Obstacles from depth images: everything seen is covered, hidden things stay, the robot's own points do not count."""

import math

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.integration.point_clouds.point_cloud_source import PointCloudConfig, PointCloudSource
from dualbrain.safety.integration.scene_fusion import SceneFusion, SourceAccepted
from tests.safety.integration.point_clouds.rendered_boxes import CAMERA, render_depth

ABOVE = Pose((0.45, 0.0, 1.6), (0.0, 1.0, 0.0, 0.0))
"""A camera that looks straight down: half a turn about x."""
FLOOR = ((-3.0, -3.0, -0.2), (3.0, 3.0, -0.1))
CRATE = ((0.55, -0.35, 0.0), (0.75, -0.15, 0.3))
LOWER, UPPER = (-0.3, -0.8, 0.0), (1.0, 0.8, 1.2)
TABLE = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, -0.1)))
CONFIG = PointCloudConfig(lower=LOWER, upper=UPPER)


@pytest.fixture(scope="module")
def safety():
    return SafetyFilter(load_robot("panda"), obstacles=[TABLE])


@pytest.fixture(scope="module")
def home(safety):
    return np.array(safety.robot_model.home)


def robot_boxes(safety, q):
    """Boxes in the spheres of the robot, which a camera sees as its body."""
    centres, radii, _ = safety.spheres(q, None)
    return [(c - r / math.sqrt(3), c + r / math.sqrt(3)) for c, r in zip(centres, radii, strict=True)]


def noisy(depth, seed=0, sigma=0.0005):
    return np.where(depth > 0.0, depth + np.random.default_rng(seed).normal(0.0, sigma, depth.shape), 0.0)


def is_covered(report, points):
    """Which of `points` (n, 3) are in a shape with its error."""
    found = np.zeros(len(points), bool)
    for one in report.shapes:
        gaps = np.abs(points - one.pose.position) - one.shape.half_extents - one.error
        found |= (gaps <= 1e-9).all(axis=1)
    return found


@pytest.fixture
def source(safety):
    return PointCloudSource("camera", safety, CONFIG, [TABLE])


def test_every_measured_point_is_covered_and_the_robot_is_not(source, safety, home):
    depth = noisy(render_depth([FLOOR, CRATE, *robot_boxes(safety, home)], ABOVE))
    report = source.observe_depth(depth, CAMERA, ABOVE, 0.0, home)
    assert not report.problem
    assert 0 < len(report.shapes) <= CONFIG.max_boxes
    top = np.column_stack([np.random.default_rng(1).uniform(CRATE[0][:2], CRATE[1][:2], (300, 2)), np.full(300, 0.3)])
    assert is_covered(report, top).all()
    assert report.clearance > 0.0
    assert report.lost < CONFIG.voxel
    centres, *_ = safety.spheres(home, None)
    assert not is_covered(report, centres).any()


def test_an_obstacle_that_the_arm_hides_stays_and_one_that_was_removed_ends(source, safety, home):
    source.observe_depth(noisy(render_depth([FLOOR, CRATE], ABOVE)), CAMERA, ABOVE, 0.0, home)
    lid = ((0.4, -0.5, 0.8), (0.9, 0.0, 0.85))
    hidden = source.observe_depth(noisy(render_depth([FLOOR, CRATE, lid], ABOVE), 1), CAMERA, ABOVE, 0.1, home)
    assert is_covered(hidden, np.array([[0.65, -0.25, 0.3]])).all()
    seen = source.observe_depth(noisy(render_depth([FLOOR], ABOVE), 2), CAMERA, ABOVE, 0.2, home)
    assert seen.shapes == ()


def test_the_filter_stops_before_everything_that_the_camera_sees(source, safety, home):
    """A wall before the hand, at full speed towards it: its points are never within the margin of the robot's body."""
    wall = ((0.62, -0.6, 0.1), (0.66, 0.6, 1.0))
    side = Pose((-0.6, 0.0, 0.6), (0.5, -0.5, 0.5, -0.5))
    fusion, q, u = SceneFusion({"camera": source.scene_source(0.2)}), home.copy(), np.zeros(7)
    points = np.array([[wall[0][0], y, z] for y in np.linspace(-0.5, 0.5, 21) for z in np.linspace(0.1, 1.0, 19)])
    period, nearest = safety.robot_model.period, math.inf
    for k in range(900):
        now = k * period
        if k % 50 == 0:
            depth = noisy(render_depth([FLOOR, wall], side), k)
            report = source.observe_depth(depth, CAMERA, side, now, q)
            accepted = fusion.update("camera", "world", now, report.shapes, now=now)
            assert accepted == SourceAccepted("camera", len(report.shapes))
        fusion.apply_to(safety, now)
        forward = safety.tool(q).jacobian[:3].T @ np.array([1.5, 0.0, 0.0])
        u = safety(q, u, forward, now).u
        q = q + period * u
        centres, radii, _ = safety.spheres(q, None)
        gaps = np.linalg.norm(points[:, None] - centres, axis=-1) - radii
        nearest = min(nearest, gaps.min())
    assert CONFIG.self_margin < nearest < 0.1
    assert abs(safety.tool(q).jacobian[0] @ u) < 0.03


def test_points_beside_the_body_are_the_robot_itself(source, safety, home):
    centres, radii, _ = safety.spheres(home, None)
    own = centres + (radii + 0.5 * CONFIG.self_margin)[:, None] * np.array([1.0, 0.0, 0.0])
    report = source.observe_points(own, (2.0, 0.0, 0.5), 0.0, home)
    assert report.shapes == ()


def test_known_obstacles_are_left_to_themselves(safety, home):
    floor_in_view = PointCloudConfig(lower=(-0.3, -0.8, -0.2), upper=UPPER)
    points = np.column_stack([np.random.default_rng(0).uniform(-0.3, 0.8, (500, 2)), np.full(500, -0.1)])
    with_known = PointCloudSource("camera", safety, floor_in_view, [TABLE])
    without = PointCloudSource("camera", safety, floor_in_view)
    origin = (0.4, 0.0, 1.6)
    assert with_known.observe_points(points, origin, 0.0, home).shapes == ()
    assert without.observe_points(points, origin, 0.0, home).shapes


def test_people_are_obstacles_that_move_and_are_not_kept(source, home):
    points = np.random.default_rng(0).uniform((0.7, 0.3, 0.3), (0.8, 0.5, 0.9), (400, 3))
    origin, marked = (0.4, 0.0, 1.6), np.ones(400, bool)
    report = source.observe_points(points, origin, 0.0, home, people=marked)
    assert is_covered(report, points).all()
    assert all(one.person and one.velocity_error == CONFIG.person_speed for one in report.shapes)
    fusion = SceneFusion({"camera": source.scene_source(0.2)})
    fusion.update("camera", "world", 0.0, report.shapes, now=0.0)
    assert {one.rank for one in fusion.obstacles(0.0)} == {Rank.BODY}
    assert source.observe_points(np.array([[0.9, 0.7, 0.1]]), origin, 0.1, home).n_voxels == 1


def test_unknown_space_is_an_obstacle_only_on_request(safety, home):
    careful = PointCloudSource("camera", safety, PointCloudConfig(lower=LOWER, upper=UPPER, unknown_is_occupied=True))
    depth = noisy(render_depth([FLOOR, CRATE], ABOVE))
    report = careful.observe_depth(depth, CAMERA, ABOVE, 0.0, home)
    beside = np.array([[0.65, -0.36 - CONFIG.voxel, 0.05]])  # in the shadow of the crate, seen from above
    assert (
        report.n_voxels
        > PointCloudSource("camera", safety, CONFIG).observe_depth(depth, CAMERA, ABOVE, 0.0, home).n_voxels
    )
    assert is_covered(report, beside).all()


def test_space_near_the_robot_is_free_at_the_start_only_if_it_is_declared_so(safety, home):
    def unknown_near(free_at_start):
        config = PointCloudConfig(lower=LOWER, upper=UPPER, unknown_is_occupied=True, free_at_start=free_at_start)
        boxes = [FLOOR, *robot_boxes(safety, home)]
        source = PointCloudSource("camera", safety, config)
        return source.observe_depth(noisy(render_depth(boxes, ABOVE)), CAMERA, ABOVE, 0.0, home).clearance

    assert unknown_near(0.0) < 0.05
    assert unknown_near(0.2) > 0.2 - 2 * CONFIG.voxel


def test_silence_of_the_camera_stops_the_arm(source, safety, home):
    fusion = SceneFusion({"camera": source.scene_source(0.2)})
    report = source.observe_depth(noisy(render_depth([FLOOR, CRATE], ABOVE)), CAMERA, ABOVE, 0.0, home)
    fusion.update("camera", "world", 0.0, report.shapes, now=0.0)
    assert fusion.apply_to(safety, 0.1) == ()
    assert fusion.apply_to(safety, 0.3) == ("camera",)
    assert safety(home, np.zeros(7), np.full(7, 0.1), 0.3).status is FilterStatus.STOPPED


def test_a_covered_or_frozen_camera_is_refused_with_cause_and_remedy(source, home):
    depth = noisy(render_depth([FLOOR, CRATE], ABOVE))
    dark = np.where(np.random.default_rng(0).uniform(size=depth.shape) < 0.9, np.nan, depth)
    covered = source.observe_depth(dark, CAMERA, ABOVE, 0.0, home)
    assert covered.shapes == ()
    assert "covered" in covered.problem
    problems = [source.observe_depth(depth, CAMERA, ABOVE, 0.1 * k, home).problem for k in range(1, 6)]
    assert problems[:3] == ["", "", ""]
    assert all("frozen" in problem for problem in problems[3:])
    assert "no finite point" in source.observe_points(np.full((5, 3), np.nan), (0.0, 0.0, 1.0), 1.0, home).problem


def test_an_old_frame_does_not_free_space_that_a_later_one_saw_as_occupied(source, home):
    source.observe_depth(noisy(render_depth([FLOOR, CRATE], ABOVE)), CAMERA, ABOVE, 1.0, home)
    late = source.observe_depth(noisy(render_depth([FLOOR], ABOVE), 1), CAMERA, ABOVE, 0.9, home)
    assert "out of order" in late.problem
    after = source.observe_depth(noisy(render_depth([FLOOR, CRATE], ABOVE), 2), CAMERA, ABOVE, 1.0, home)
    assert is_covered(after, np.array([[0.65, -0.25, 0.3]])).all()
    assert "out of order" in source.observe_points(np.ones((3, 3)), (0.0, 0.0, 2.0), 0.5, home).problem


def test_depths_in_millimetres_are_refused_with_the_unit(source, home):
    depth = np.full((CAMERA.height, CAMERA.width), 1600, np.uint16)
    assert "metres" in source.observe_depth(depth, CAMERA, ABOVE, 0.0, home).problem


@pytest.mark.parametrize("stamp", [math.nan, math.inf, "now"])
def test_a_stamp_that_is_no_time_is_an_error(source, home, stamp):
    depth = noisy(render_depth([FLOOR, CRATE], ABOVE))
    with pytest.raises(GeometryError, match="stamp"):
        source.observe_depth(depth, CAMERA, ABOVE, stamp, home)
    with pytest.raises(GeometryError, match="stamp"):
        source.observe_points(np.ones((3, 3)), (0.0, 0.0, 2.0), stamp, home)


@pytest.mark.parametrize(
    "changed",
    [
        {"depth": np.ones((60, 79))},
        {"q": np.full(7, np.nan)},
        {"q": np.zeros(6)},
        {"pose": Pose((0.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0))},
        {"people": np.zeros((60, 80))},
        {"people": np.zeros((3, 3), bool)},
    ],
    ids=["another size", "NaN in q", "six joints", "no rotation", "numbers as mask", "a small mask"],
)
def test_input_that_is_not_usable_is_an_error(source, home, changed):
    given = {"depth": np.ones((60, 80)), "q": home, "pose": ABOVE, "people": None} | changed
    with pytest.raises((GeometryError, ConfigurationError)):
        source.observe_depth(given["depth"], CAMERA, given["pose"], 0.0, given["q"], people=given["people"])


@pytest.mark.parametrize(
    "field",
    [
        {"self_margin": 0.001},
        {"error": -1.0},
        {"max_boxes": 0},
        {"min_valid_share": 2.0},
        {"speed": math.nan},
        {"memory": -1.0},
        {"memory": math.nan},
        {"unknown_is_occupied": "yes"},
    ],
    ids=str,
)
def test_a_configuration_that_is_not_usable_is_an_error(field):
    with pytest.raises(GeometryError):
        PointCloudConfig(lower=LOWER, upper=UPPER, **field)


# --- several sensors, and things on known obstacles -----------------------------------------------------------------

SIDE = Pose((-0.6, 0.0, 0.6), (0.5, -0.5, 0.5, -0.5))
ON_TABLE = PointCloudConfig(lower=(-0.3, -0.8, -0.1), upper=UPPER)
PLATE = ((0.55, -0.35, -0.1), (0.75, -0.15, -0.088))
"""A plate of 12 mm on the table: lower than a voxel."""


def look(source, home, stamp, boxes=(FLOOR, CRATE), pose=ABOVE, sensor="left", seed=None):
    depth = noisy(render_depth(boxes, pose), round(1e3 * stamp) if seed is None else seed)
    return source.observe_depth(depth, CAMERA, pose, stamp, home, sensor=sensor)


def test_a_frozen_camera_beside_one_that_works_is_noticed(source, home):
    problems = []
    for k in range(8):
        look(source, home, 0.1 * k)
        problems.append(look(source, home, 0.1 * k, pose=SIDE, sensor="right", seed=7).problem)
    assert not any(problems[:3])
    assert all("'right'" in problem and "frozen" in problem for problem in problems[3:])


def test_a_camera_that_is_delivered_later_is_used(source, home):
    for k in range(4):
        assert not look(source, home, 1.0 + 0.1 * k).problem
        assert not look(source, home, 0.95 + 0.1 * k, pose=SIDE, sensor="right").problem


def test_an_older_frame_of_another_camera_does_not_free_what_a_later_one_saw(source, home):
    look(source, home, 1.0)
    after = look(source, home, 0.9, boxes=[FLOOR], sensor="right")
    assert not after.problem
    assert is_covered(after, np.array([[0.65, -0.25, 0.3]])).all()
    assert look(source, home, 1.1, boxes=[FLOOR], sensor="right").shapes == ()


def test_a_silent_camera_is_reported_although_another_one_works(source, home):
    look(source, home, 0.0, pose=SIDE, sensor="right")
    reports = [look(source, home, 0.1 * k) for k in range(12)]
    assert not reports[3].problem
    assert "'right'" in reports[11].problem
    assert "check its driver" in reports[11].problem
    assert reports[11].shapes == ()
    assert not look(source, home, 1.15, pose=SIDE, sensor="right").problem


def test_a_declared_camera_that_has_never_delivered_is_reported(safety, home):
    source = PointCloudSource("cameras", safety, CONFIG, [TABLE], sensors=("left", "right"))
    assert "'right' has delivered no frame" in look(source, home, 0.0).problem
    assert not look(source, home, 0.0, pose=SIDE, sensor="right").problem
    with pytest.raises(UnknownNameError, match="middle"):
        look(source, home, 0.1, sensor="middle")


def test_people_of_one_camera_stay_in_the_reports_of_another_one(safety, home):
    """The last report of a source replaces the one before; the boxes also cover the way since the older frame."""
    source, rng = PointCloudSource("cameras", safety, CONFIG, sensors=("left", "right")), np.random.default_rng(0)
    people, thing = rng.uniform((0.7, 0.3, 0.3), (0.8, 0.5, 0.9), (400, 3)), np.array([[0.9, 0.7, 0.1]])

    def observe(points, stamp, sensor, *, marked):
        return source.observe_points(
            points, (0.4, 0.0, 1.6), stamp, home, people=np.full(len(points), marked), sensor=sensor
        )

    observe(thing, 0.0, "right", marked=False)
    observe(people, 0.1, "left", marked=True)
    report = observe(thing + 1e-4, 0.3, "right", marked=False)
    persons = [one for one in report.shapes if one.person]
    assert len(persons) <= CONFIG.max_person_boxes
    walked = people - np.array([CONFIG.person_speed * 0.2, 0.0, 0.0])
    assert is_covered(report, people).all()
    assert is_covered(report, walked).all()
    observe(thing + 2e-4, 0.4, "left", marked=False)
    assert not any(one.person for one in observe(thing + 3e-4, 0.5, "right", marked=False).shapes)


def test_a_late_frame_of_one_camera_is_in_the_fused_scene(safety, home):
    """Its report also contains what the other camera saw, and counts from the stamp of the late frame."""
    source = PointCloudSource("cameras", safety, CONFIG, sensors=("left", "right"))
    fusion = SceneFusion({"cameras": source.scene_source(max_age=0.25)})
    things = {"left": (0.9, 0.7, 0.1), "right": (0.9, -0.7, 0.1)}
    for sensor, stamp in (("right", 0.0), ("left", 0.1), ("right", 0.05)):
        report = source.observe_points(np.array([things[sensor]]), (0.4, 0.0, 1.6), stamp, home, sensor=sensor)
        if not report.problem:
            assert isinstance(fusion.update("cameras", "world", stamp, report.shapes, now=0.1), SourceAccepted)
    assert is_covered(report, np.array(list(things.values()))).all()
    assert len(fusion.obstacles(0.1)) == len(report.shapes)
    assert fusion.silent_sources(0.29) == ()
    assert fusion.silent_sources(0.31) == ("cameras",)


def test_a_source_that_was_reset_accepts_the_new_clock_and_keeps_what_it_saw(source, home):
    look(source, home, 1000.0)
    refused = look(source, home, 1.0)
    assert "out of order" in refused.problem
    assert "call `reset`" in refused.problem
    source.reset()
    lid = ((0.4, -0.5, 0.8), (0.9, 0.0, 0.85))
    accepted = look(source, home, 1.0, boxes=[FLOOR, CRATE, lid])
    assert not accepted.problem
    assert is_covered(accepted, np.array([[0.65, -0.25, 0.3]])).all()
    assert look(source, home, 1.1, boxes=[FLOOR]).shapes == ()


@pytest.mark.parametrize("pose", [ABOVE, Pose((0.65, -0.25, 0.9), (0.0, 1.0, 0.0, 0.0))], ids=["far", "near"])
def test_a_thing_on_the_table_that_is_lower_than_a_voxel_is_an_obstacle_until_it_is_removed(safety, home, pose):
    source = PointCloudSource("camera", safety, ON_TABLE, [TABLE])
    top = np.column_stack(
        [np.random.default_rng(1).uniform((0.56, -0.34), (0.74, -0.16), (200, 2)), np.full(200, -0.088)]
    )
    for k in range(4):
        seen = look(source, home, 0.1 * k, boxes=[FLOOR, PLATE], pose=pose)
    assert is_covered(seen, top).all()
    assert look(source, home, 0.5, boxes=[FLOOR], pose=pose).shapes == ()


def test_a_thing_on_the_table_in_a_cloud_is_an_obstacle_until_it_is_removed(safety, home):
    source, rng, origin = (
        PointCloudSource("lidar", safety, ON_TABLE, [TABLE]),
        np.random.default_rng(1),
        (0.4, 0.0, 1.6),
    )
    table = np.column_stack([rng.uniform((0.4, -0.5), (0.8, 0.0), (9000, 2)), np.full(9000, -0.1)])
    plate = np.column_stack([rng.uniform(PLATE[0][:2], PLATE[1][:2], (400, 2)), np.full(400, PLATE[1][2])])
    report = source.observe_points(np.concatenate([table, plate]), origin, 0.0, home)
    assert is_covered(report, plate).all()
    assert source.observe_points(table + 1e-4, origin, 0.1, home).shapes == ()
