"""Fusion of several sources with their own frames: poses and bounds are right, implausible reports change nothing."""

import math

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter
from dualbrain.safety.cbf.kernel import MAX_OBSTACLES
from dualbrain.safety.cbf.result import Reason
from dualbrain.safety.integration.scene_fusion import (
    FrameMount,
    PerceivedShape,
    SceneFusion,
    SceneSource,
    SourceAccepted,
    SourceRefused,
)

TURN = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""A quarter turn about z."""
FRAMES = {
    "mast": FrameMount(pose=Pose((1.0, 0.0, 0.5), TURN), error=0.001, angle_error=0.01),
    "lens": FrameMount(pose=Pose((0.0, 0.2, 0.0)), parent="mast", error=0.002),
    "wrist": FrameMount(time_tolerance=0.02),
}
SOURCES = {"camera": SceneSource(error=0.004, max_age=0.2), "map": SceneSource(error=0.0, max_age=1e6)}
BALL = PerceivedShape(name="ball", shape=Sphere(0.05), pose=Pose((0.3, 0.0, 0.0)))


def fusion():
    return SceneFusion(SOURCES, FRAMES)


def test_a_shape_is_transformed_through_its_frames_with_all_their_errors():
    scene = fusion()
    seen = msgspec.structs.replace(BALL, velocity=(0.1, 0.0, 0.0), error=0.003, velocity_error=0.05)
    assert scene.update("camera", "lens", 0.0, [seen], now=0.1) == SourceAccepted("camera", 1)
    (ball,) = scene.obstacles(0.1)
    turned = quaternion_to_matrix(TURN)
    place = turned @ [0.3, 0.2, 0.0] + [1.0, 0.0, 0.5] + 0.1 * turned @ [0.1, 0.0, 0.0]
    assert np.allclose(ball.pose.position, place)
    assert np.allclose(ball.velocity, turned @ [0.1, 0.0, 0.0])
    lever = math.hypot(0.3, 0.2)
    assert ball.margin == pytest.approx(0.003 + 0.004 + 0.002 + 0.001 + 0.01 * lever + (0.05 + 0.01 * 0.1) * 0.1)
    assert not ball.static


@pytest.mark.parametrize("shape", [Box((1.0, 0.1, 0.2)), Capsule(0.1, 1.0)], ids=["box", "capsule"])
def test_the_margin_covers_every_point_of_a_long_shape_in_a_frame_with_an_error_of_the_angle(shape):
    """The frame is turned by its error: the ends of the shape move, although its centre is at the axis."""
    angle = 0.05
    scene = SceneFusion({"camera": SceneSource(error=0.0, max_age=1.0)}, {"mast": FrameMount(angle_error=angle)})
    scene.update("camera", "mast", 0.0, [PerceivedShape(name="beam", shape=shape, pose=Pose((0.0, 0.0, 0.0)))], now=0.0)
    (beam,) = scene.obstacles(0.0)
    turned = Pose((0.0, 0.0, 0.0), (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0))
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.3, 1.3, (60_000, 3))
    inside = points[signed_distance(shape, turned, points) <= 0.0]
    assert len(inside) > 100
    assert signed_distance(beam.shape, beam.pose, inside).max() <= beam.margin


@pytest.mark.parametrize("frame", ["mast", "lens"])
def test_a_half_space_in_a_frame_with_an_error_of_the_angle_is_rejected(frame):
    scene, floor = fusion(), PerceivedShape(name="floor", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))
    answer = scene.update("map", frame, 0.0, [BALL, floor], now=0.0)
    assert isinstance(answer, SourceRefused)
    assert "'floor'" in answer.reason
    assert "state the plane in the frame 'world' of the robot base" in answer.reason
    assert scene.obstacles(0.0) == ()
    assert scene.update("map", "world", 0.0, [floor], now=0.0) == SourceAccepted("map", 1)
    exact = SceneFusion(SOURCES, {"mast": FrameMount(error=0.002)})
    assert exact.update("map", "mast", 0.0, [floor], now=0.0) == SourceAccepted("map", 1)
    assert exact.obstacles(0.0)[0].margin == pytest.approx(0.002)


def test_each_source_replaces_only_its_own_shapes():
    scene = fusion()
    scene.update("camera", "world", 0.0, [BALL], now=0.0)
    scene.update("map", "world", 0.0, [msgspec.structs.replace(BALL, shape=Box((1.0, 1.0, 0.1)))], now=0.0)
    scene.update("camera", "world", 0.1, [], now=0.1)
    assert [obstacle.name for obstacle in scene.obstacles(0.1)] == ["map/ball"]


@pytest.mark.parametrize(
    ("source", "frame", "stamp", "shape", "reason"),
    [
        ("lidar", "world", 0.0, BALL, "source 'lidar' is unknown"),
        ("camera", "lense", 0.0, BALL, "frame 'lense' is unknown; known: world, mast, lens, wrist"),
        ("camera", "world", -0.3, BALL, "exceeds the limit of 0.2 s"),
        ("camera", "world", 0.5, BALL, "after the current time"),
        ("camera", "world", math.nan, BALL, "not finite"),
        ("camera", "wrist", 0.0, BALL, "the pose of frame 'wrist'"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, pose=Pose((math.nan, 0, 0))), "not finite"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, shape=Sphere(-1.0)), "below zero"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, error=math.inf), "not finite"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, pose=Pose((0, 0, 0), (2, 0, 0, 0))), "quaternion"),
    ],
)
def test_an_implausible_report_is_rejected_as_a_value_and_changes_nothing(source, frame, stamp, shape, reason):
    scene = fusion()
    scene.update("camera", "world", -0.1, [BALL], now=0.0)
    before = scene.obstacles(0.0)
    answer = scene.update(source, frame, stamp, [shape], now=0.0)
    assert isinstance(answer, SourceRefused)
    assert reason in answer.reason
    assert scene.obstacles(0.0) == before


def test_time_does_not_run_backward_and_names_are_not_used_twice():
    scene = fusion()
    scene.update("camera", "world", 0.1, [BALL], now=0.1)
    assert "before the last stamp" in scene.update("camera", "world", 0.05, [BALL], now=0.1).reason
    assert "twice" in scene.update("camera", "world", 0.1, [BALL, BALL], now=0.1).reason
    many = [msgspec.structs.replace(BALL, name=f"b{i}") for i in range(MAX_OBSTACLES)]
    assert f"limit of {MAX_OBSTACLES}" in scene.update("camera", "world", 0.1, many, now=0.1).reason


def test_a_moving_frame_applies_to_reports_near_its_time():
    scene = fusion()
    scene.set_frame_pose("wrist", Pose((0.0, 0.0, 1.0)), 0.10)
    assert isinstance(scene.update("camera", "wrist", 0.11, [BALL], now=0.12), SourceAccepted)
    assert scene.obstacles(0.12)[0].pose.position == pytest.approx((0.3, 0.0, 1.0))
    assert isinstance(scene.update("camera", "wrist", 0.15, [BALL], now=0.15), SourceRefused)
    with pytest.raises(UnknownNameError):
        scene.set_frame_pose("elbow", Pose((0, 0, 0)), 0.0)


def test_a_silent_required_source_stops_the_robot_until_it_reports_again():
    scene, safety = (
        SceneFusion(
            {
                "camera": SceneSource(error=0.0, max_age=0.2),
                "clock": SceneSource(error=0.0, max_age=9.0, required=False),
            }
        ),
        SafetyFilter(load_robot("panda")),
    )
    q, u = np.array(safety.robot_model.home), np.full(7, 0.01)
    assert scene.apply_to(safety, 0.0) == ("camera",)
    assert safety(q, np.zeros(7), u, 0.0).status is FilterStatus.STOPPED
    scene.update("camera", "world", 1.0, [], now=1.0)
    assert scene.apply_to(safety, 1.1) == ()
    assert safety(q, np.zeros(7), u, 1.1).status is not FilterStatus.STOPPED
    assert scene.apply_to(safety, 1.3) == ("camera",)
    stopped = safety(q, np.zeros(7), u, 1.3)
    assert stopped.status is FilterStatus.STOPPED
    assert Reason(stopped.flags) & Reason.STALE_SCENE


def test_frames_in_a_cycle_or_without_a_parent_are_rejected():
    with pytest.raises(ConfigurationError, match="cycle"):
        SceneFusion({}, {"a": FrameMount(parent="b"), "b": FrameMount(parent="a")})
    with pytest.raises(UnknownNameError):
        SceneFusion({}, {"a": FrameMount(parent="nowhere")})
    with pytest.raises(ConfigurationError):
        SceneFusion({"camera": SceneSource(error=-1.0, max_age=1.0)})


def test_a_frozen_source_is_rejected_until_it_reports_new_values():
    scene = fusion()
    for k in range(10):
        scene.update("map", "world", 0.05 * k, [BALL], now=0.05 * k)
        answer = scene.update("camera", "world", 0.05 * k, [BALL], now=0.05 * k)
        assert isinstance(answer, SourceRefused) == (k >= SOURCES["camera"].max_repeats), (
            "a map without error may repeat itself"
        )
    assert "identical bit for bit" in answer.reason
    assert scene.silent_sources(0.45) == ("camera",)
    seen = msgspec.structs.replace(BALL, pose=Pose((0.3, 0.0, 1e-9)))
    assert scene.update("camera", "world", 0.5, [seen], now=0.5) == SourceAccepted("camera", 1)
    assert scene.silent_sources(0.5) == ()


def test_a_map_may_repeat_itself():
    scene = SceneFusion({"map": SceneSource(error=0.01, max_age=1.0, max_repeats=None)})
    assert all(
        isinstance(scene.update("map", "world", float(k), [BALL], now=float(k)), SourceAccepted) for k in range(9)
    )


def test_a_person_of_a_camera_that_stays_silent_is_widened_up_to_the_largest_age():
    scene, safety = SceneFusion({"camera": SceneSource(error=0.0, max_age=0.2)}), SafetyFilter(load_robot("panda"))
    person = msgspec.structs.replace(BALL, velocity=(1.0, 0.0, 0.0), velocity_error=1.6, person=True)
    scene.update("camera", "world", 0.0, [person], now=0.0)
    assert scene.apply_to(safety, 5000.0) == ("camera",)
    (seen,) = scene.obstacles(5000.0)
    assert seen.margin == pytest.approx(0.2 * 1.6)
    assert seen.pose.position[0] == pytest.approx(0.3 + 0.2)
