"""Room of a push: to the edge of a bounded support, and to the first thing that the object would meet."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.records import FailureCause, SceneObject
from dualbrain.skills.arm import push
from dualbrain.skills.kinematics.push_room import push_room
from dualbrain.skills.skill import Observation, SkillStatus
from tests.grounding.perceived_scenes import bowl, box, scene, yaw_quaternion
from tests.skills.arm.test_blocked_waypoints import KinematicCell

BENCH = SceneObject(name="bench", role="support", shape=Box((0.4, 0.3, 0.25)), pose=Pose((0.5, 0.0, -0.25)))
CUBE, HALF, ERROR = box("red_cube", 0.5, 0.0, error=0.009), 0.02, 0.009
AHEAD, LEFT = np.array([1.0, 0.0]), np.array([0.0, 1.0])


def on_bench(*objects, support=BENCH, places=()):
    """A scene whose only support is the bench."""
    found = scene(*objects, places=places)
    return msgspec.structs.replace(found, objects=(support, *objects))


@pytest.mark.parametrize(("direction", "edge"), [(AHEAD, 0.4), (-AHEAD, 0.4), (LEFT, 0.3), (-LEFT, 0.3)])
def test_the_whole_outline_stays_on_a_bounded_support(direction, edge):
    room = push_room(on_bench(CUBE), CUBE, direction)
    assert room.limit == "the edge of bench"
    assert room.distance == pytest.approx(edge - HALF - ERROR)
    assert push_room(scene(CUBE), CUBE, direction).distance == np.inf  # a table without an edge


def test_the_edge_of_a_turned_support_is_turned():
    turned = msgspec.structs.replace(BENCH, pose=Pose(BENCH.pose.position, yaw_quaternion(0.5)))
    along = np.array([np.cos(0.5), np.sin(0.5)])
    cube = box("red_cube", 0.5, 0.0, yaw=0.5)
    assert push_room(on_bench(cube, support=turned), cube, along).distance == pytest.approx(0.4 - HALF)


def test_an_object_at_the_edge_may_be_pushed_away_from_it():
    cube = box("red_cube", 0.88, 0.0)
    assert push_room(on_bench(cube), cube, AHEAD).distance == pytest.approx(0.0, abs=1e-9)
    assert push_room(on_bench(cube), cube, -AHEAD).distance == pytest.approx(0.8 - 2 * HALF)


def test_a_support_that_does_not_bear_the_object_has_no_edge_for_it():
    lower = msgspec.structs.replace(BENCH, pose=Pose((0.5, 0.0, -0.5)))
    beside = msgspec.structs.replace(BENCH, pose=Pose((1.5, 0.0, -0.25)))
    for support in (lower, beside):
        assert push_room(on_bench(CUBE, support=support), CUBE, AHEAD).distance == np.inf


@pytest.mark.parametrize(
    ("other", "distance"),
    [
        (bowl(0.5, 0.26), 0.26 - 0.085 - HALF - ERROR),
        (box("tin", 0.53, 0.2), 0.2 - 2 * HALF - ERROR),
        (box("tin", 0.545, 0.2), np.inf),  # passes beside it
        (box("tin", 0.5, -0.2), np.inf),  # behind
        (box("board", 0.5, 0.2, (0.2, 0.1, 0.01), role="obstacle", z=0.3), np.inf),  # above it
        (box("tray", 0.5, 0.02, (0.1, 0.1, 0.01), z=-0.005), np.inf),  # below it, within the errors
        (box("post", 0.5, 0.2, (0.02, 0.02, 0.2), role="obstacle"), 0.2 - 2 * HALF - ERROR),
    ],
)
def test_a_push_ends_before_the_first_thing_in_its_way(other, distance):
    room = push_room(scene(CUBE, other), CUBE, LEFT)
    assert room.distance == pytest.approx(distance)
    assert room.limit == ("" if distance == np.inf else other.name)


def begin_push(distance):
    """The first step of a push of `distance` [m] on the bench, toward its edge, 8 cm before which the cube begins."""
    cell = KinematicCell()
    perceived = on_bench(box("red_cube", 0.5, 0.2), places=(("aisle", (0.5, 0.6, -0.5)),))
    tool = cell.safety.tool(cell.state.q)
    cell.controller.observe(Observation(state=cell.state, scene=perceived, now=0.0, tool=tool))
    options = {"speed": 0.2, "clearance": 0.1, "wait": "none"}
    return next(push.routine(cell.controller, object="red_cube", destination="aisle", distance=distance, **options))


def test_a_push_over_the_edge_fails_before_the_arm_moves():
    with pytest.raises(StopIteration) as ended:
        begin_push(0.15)
    result = ended.value.value
    assert (result.status, result.cause) == (SkillStatus.FAILED, FailureCause.PRECONDITION)
    assert result.reason == "the longest push of red_cube toward aisle is 8.0 cm: to the edge of bench"
    begin_push(0.05)  # begins with the search for a pose of the hand
