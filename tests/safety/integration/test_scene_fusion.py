"""Several sources, each in its own frame: poses and bounds come out right, what cannot be believed changes nothing."""

import math

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Pose, Sphere
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


def feed():
    return SceneFusion(SOURCES, FRAMES)


def test_a_shape_is_carried_through_its_frames_with_every_error_on_the_way():
    one = feed()
    seen = msgspec.structs.replace(BALL, velocity=(0.1, 0.0, 0.0), error=0.003, velocity_error=0.05)
    assert one.update("camera", "lens", 0.0, [seen], now=0.1) == SourceAccepted("camera", 1)
    (ball,) = one.obstacles(0.1)
    turned = quaternion_to_matrix(TURN)
    place = turned @ [0.3, 0.2, 0.0] + [1.0, 0.0, 0.5] + 0.1 * turned @ [0.1, 0.0, 0.0]
    assert np.allclose(ball.pose.position, place)
    assert np.allclose(ball.velocity, turned @ [0.1, 0.0, 0.0])
    lever = math.hypot(0.3, 0.2)
    assert ball.margin == pytest.approx(0.003 + 0.004 + 0.002 + 0.001 + 0.01 * lever + 0.05 * 0.1)
    assert not ball.static


def test_sources_stand_beside_each_other_and_each_replaces_only_its_own():
    one = feed()
    one.update("camera", "world", 0.0, [BALL], now=0.0)
    one.update("map", "world", 0.0, [msgspec.structs.replace(BALL, shape=Box((1.0, 1.0, 0.1)))], now=0.0)
    one.update("camera", "world", 0.1, [], now=0.1)
    assert [thing.name for thing in one.obstacles(0.1)] == ["map/ball"]


@pytest.mark.parametrize(
    ("source", "frame", "stamp", "shape", "said"),
    [
        ("lidar", "world", 0.0, BALL, "source 'lidar' is not known"),
        ("camera", "lense", 0.0, BALL, "frame 'lense' is not known; known: world, mast, lens, wrist"),
        ("camera", "world", -0.3, BALL, "at most 0.2 s are believed"),
        ("camera", "world", 0.5, BALL, "future"),
        ("camera", "world", math.nan, BALL, "no time"),
        ("camera", "wrist", 0.0, BALL, "frame 'wrist' was placed at"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, pose=Pose((math.nan, 0, 0))), "not finite"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, shape=Sphere(-1.0)), "below zero"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, error=math.inf), "not finite"),
        ("camera", "world", 0.0, msgspec.structs.replace(BALL, pose=Pose((0, 0, 0), (2, 0, 0, 0))), "quaternion"),
    ],
)
def test_what_cannot_be_believed_is_refused_as_a_value_and_changes_nothing(source, frame, stamp, shape, said):
    one = feed()
    one.update("camera", "world", -0.1, [BALL], now=0.0)
    before = one.obstacles(0.0)
    answer = one.update(source, frame, stamp, [shape], now=0.0)
    assert isinstance(answer, SourceRefused)
    assert said in answer.reason
    assert one.obstacles(0.0) == before


def test_time_does_not_run_backward_and_names_are_not_used_twice():
    one = feed()
    one.update("camera", "world", 0.1, [BALL], now=0.1)
    assert "older than the last" in one.update("camera", "world", 0.05, [BALL], now=0.1).reason
    assert "twice" in one.update("camera", "world", 0.1, [BALL, BALL], now=0.1).reason
    many = [msgspec.structs.replace(BALL, name=f"b{i}") for i in range(MAX_OBSTACLES)]
    assert f"room for {MAX_OBSTACLES}" in one.update("camera", "world", 0.1, many, now=0.1).reason


def test_a_frame_that_moves_serves_what_was_seen_while_it_was_there():
    one = feed()
    one.set_frame_pose("wrist", Pose((0.0, 0.0, 1.0)), 0.10)
    assert isinstance(one.update("camera", "wrist", 0.11, [BALL], now=0.12), SourceAccepted)
    assert one.obstacles(0.12)[0].pose.position == pytest.approx((0.3, 0.0, 1.0))
    assert isinstance(one.update("camera", "wrist", 0.15, [BALL], now=0.15), SourceRefused)
    with pytest.raises(UnknownNameError):
        one.set_frame_pose("elbow", Pose((0, 0, 0)), 0.0)


def test_a_required_source_that_falls_silent_stops_the_robot_and_speech_frees_it():
    one, safety = (
        SceneFusion({"camera": SceneSource(0.0, 0.2), "clock": SceneSource(0.0, 9.0, required=False)}),
        SafetyFilter(load_robot("panda")),
    )
    q, u = np.array(safety.robot_model.home), np.full(7, 0.01)
    assert one.apply_to(safety, 0.0) == ("camera",)
    assert safety(q, np.zeros(7), u, 0.0).status is FilterStatus.STOPPED
    one.update("camera", "world", 1.0, [], now=1.0)
    assert one.apply_to(safety, 1.1) == ()
    assert safety(q, np.zeros(7), u, 1.1).status is not FilterStatus.STOPPED
    assert one.apply_to(safety, 1.3) == ("camera",)
    stopped = safety(q, np.zeros(7), u, 1.3)
    assert stopped.status is FilterStatus.STOPPED
    assert Reason(stopped.flags) & Reason.STALE_SCENE


def test_frames_in_a_circle_or_without_a_parent_are_no_setup():
    with pytest.raises(ConfigurationError, match="circle"):
        SceneFusion({}, {"a": FrameMount(parent="b"), "b": FrameMount(parent="a")})
    with pytest.raises(UnknownNameError):
        SceneFusion({}, {"a": FrameMount(parent="nowhere")})
    with pytest.raises(ConfigurationError):
        SceneFusion({"camera": SceneSource(-1.0, 1.0)})


def test_a_source_that_hangs_is_refused_falls_silent_and_is_believed_again_once_it_sees():
    one = feed()
    for k in range(10):
        one.update("map", "world", 0.05 * k, [BALL], now=0.05 * k)
        said = one.update("camera", "world", 0.05 * k, [BALL], now=0.05 * k)
        assert isinstance(said, SourceRefused) == (k >= SOURCES["camera"].max_repeats), (
            "a map without error may repeat itself"
        )
    assert "equal to the bit" in said.reason
    assert one.silent_sources(0.45) == ("camera",)
    seen = msgspec.structs.replace(BALL, pose=Pose((0.3, 0.0, 1e-9)))
    assert one.update("camera", "world", 0.5, [seen], now=0.5) == SourceAccepted("camera", 1)
    assert one.silent_sources(0.5) == ()


def test_a_source_may_say_that_it_never_changes():
    one = SceneFusion({"map": SceneSource(error=0.01, max_age=1.0, max_repeats=None)})
    assert all(isinstance(one.update("map", "world", float(k), [BALL], now=float(k)), SourceAccepted) for k in range(9))
