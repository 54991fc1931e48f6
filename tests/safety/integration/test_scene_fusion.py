"""Several sources, each in its own frame: poses and bounds come out right, what cannot be believed changes nothing."""

import math

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.rotations import matrix
from dualbrain.core.geometry.shapes import Box, Pose, Sphere
from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.robots.loader import load_body
from dualbrain.safety.cbf.filter import SafetyFilter, Status
from dualbrain.safety.cbf.kernel import MOST_OBSTACLES
from dualbrain.safety.cbf.result import Reason
from dualbrain.safety.integration.scene_fusion import Mounted, Primitive, Refused, SceneFeed, Source, Updated

TURN = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""A quarter turn about z."""
FRAMES = {
    "mast": Mounted(Pose((1.0, 0.0, 0.5), TURN), error=0.001, angle=0.01),
    "lens": Mounted(Pose((0.0, 0.2, 0.0)), parent="mast", error=0.002),
    "wrist": Mounted(slack=0.02),
}
SOURCES = {"camera": Source(error=0.004, oldest=0.2), "map": Source(error=0.0, oldest=1e6)}
BALL = Primitive("ball", Sphere(0.05), Pose((0.3, 0.0, 0.0)))


def feed():
    return SceneFeed(SOURCES, FRAMES)


def test_a_shape_is_carried_through_its_frames_with_every_error_on_the_way():
    one = feed()
    seen = msgspec.structs.replace(BALL, velocity=(0.1, 0.0, 0.0), error=0.003, velocity_error=0.05)
    assert one.update("camera", "lens", 0.0, [seen], now=0.1) == Updated("camera", 1)
    (ball,) = one.obstacles(0.1)
    turned = matrix(TURN)
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
    assert isinstance(answer, Refused)
    assert said in answer.reason
    assert one.obstacles(0.0) == before


def test_time_does_not_run_backward_and_names_are_not_used_twice():
    one = feed()
    one.update("camera", "world", 0.1, [BALL], now=0.1)
    assert "older than the last" in one.update("camera", "world", 0.05, [BALL], now=0.1).reason
    assert "twice" in one.update("camera", "world", 0.1, [BALL, BALL], now=0.1).reason
    many = [msgspec.structs.replace(BALL, name=f"b{i}") for i in range(MOST_OBSTACLES)]
    assert f"room for {MOST_OBSTACLES}" in one.update("camera", "world", 0.1, many, now=0.1).reason


def test_a_frame_that_moves_serves_what_was_seen_while_it_was_there():
    one = feed()
    one.place("wrist", Pose((0.0, 0.0, 1.0)), 0.10)
    assert isinstance(one.update("camera", "wrist", 0.11, [BALL], now=0.12), Updated)
    assert one.obstacles(0.12)[0].pose.position == pytest.approx((0.3, 0.0, 1.0))
    assert isinstance(one.update("camera", "wrist", 0.15, [BALL], now=0.15), Refused)
    with pytest.raises(UnknownName):
        one.place("elbow", Pose((0, 0, 0)), 0.0)


def test_a_required_source_that_falls_silent_stops_the_robot_and_speech_frees_it():
    one, safety = (
        SceneFeed({"camera": Source(0.0, 0.2), "clock": Source(0.0, 9.0, required=False)}),
        SafetyFilter(load_body("panda")),
    )
    q, u = np.array(safety.body.home), np.full(7, 0.01)
    assert one.hand_over(safety, 0.0) == ("camera",)
    assert safety(q, np.zeros(7), u, 0.0).status is Status.STOPPED
    one.update("camera", "world", 1.0, [], now=1.0)
    assert one.hand_over(safety, 1.1) == ()
    assert safety(q, np.zeros(7), u, 1.1).status is not Status.STOPPED
    assert one.hand_over(safety, 1.3) == ("camera",)
    stopped = safety(q, np.zeros(7), u, 1.3)
    assert stopped.status is Status.STOPPED
    assert Reason(stopped.flags) & Reason.STALE_SCENE


def test_frames_in_a_circle_or_without_a_parent_are_no_setup():
    with pytest.raises(InvalidSetup, match="circle"):
        SceneFeed({}, {"a": Mounted(parent="b"), "b": Mounted(parent="a")})
    with pytest.raises(UnknownName):
        SceneFeed({}, {"a": Mounted(parent="nowhere")})
    with pytest.raises(InvalidSetup):
        SceneFeed({"camera": Source(-1.0, 1.0)})


def test_a_source_that_hangs_is_refused_falls_silent_and_is_believed_again_once_it_sees():
    one = feed()
    for k in range(10):
        one.update("map", "world", 0.05 * k, [BALL], now=0.05 * k)
        said = one.update("camera", "world", 0.05 * k, [BALL], now=0.05 * k)
        assert isinstance(said, Refused) == (k >= SOURCES["camera"].repeats), "a map without error may repeat itself"
    assert "equal to the bit" in said.reason
    assert one.silent(0.45) == ("camera",)
    seen = msgspec.structs.replace(BALL, pose=Pose((0.3, 0.0, 1e-9)))
    assert one.update("camera", "world", 0.5, [seen], now=0.5) == Updated("camera", 1)
    assert one.silent(0.5) == ()


def test_a_source_may_say_that_it_never_changes():
    one = SceneFeed({"map": Source(error=0.01, oldest=1.0, repeats=None)})
    assert all(isinstance(one.update("map", "world", float(k), [BALL], now=float(k)), Updated) for k in range(9))
