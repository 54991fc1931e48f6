"""The kinematic twin: exact motion, fingers that carry what they close on, release, and the moving person."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Sphere
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.moving_person import person_path
from dualbrain.simulation.twin.twin_plant import (
    BOWL_BOTTOM,
    TWIN_PERIOD,
    TwinPlant,
    half_extent,
    twin_model,
)
from tests.simulation.scripted_hand import HOME, PANDA, top_down_posture, yaw_of

TWIN_PANDA = twin_model(PANDA)
OPEN, CLOSED, FORCE = 0.04, 0.0, 15.0


def make_twin(family="bare", seed=0):
    return TwinPlant(make_scene(family, seed, "panda"), TWIN_PANDA)


def hold_fingers(twin, opening, seconds=1.5):
    for _ in range(round(seconds / TWIN_PERIOD)):
        twin.write(Command(np.zeros(PANDA.n), opening, FORCE))
        twin.advance()


def grip(twin, name="red_cube"):
    """Put the open hand around an object and close it."""
    pose = twin.true_pose(name)
    twin.set_configuration(top_down_posture(twin, np.array(pose.position), yaw_of(pose)), OPEN)
    hold_fingers(twin, CLOSED)


def test_joints_follow_the_control_exactly():
    twin, u = make_twin(), np.linspace(-0.3, 0.3, PANDA.n)
    for _ in range(20):
        twin.write(Command(u, OPEN, FORCE))
        twin.advance()
    state = twin.read()
    assert np.allclose(state.q, np.array(HOME) + 20 * TWIN_PERIOD * u, atol=1e-12)
    assert np.array_equal(state.v, u)
    assert state.stamp == pytest.approx(20 * TWIN_PERIOD)


def test_a_disabled_twin_does_not_move():
    twin = make_twin()
    twin.stop()
    twin.write(Command(np.full(PANDA.n, 0.5), OPEN, FORCE))
    twin.advance()
    assert np.array_equal(twin.read().q, HOME)
    assert not twin.read().drive_enabled


def test_links_are_where_the_full_simulation_has_them():
    q = np.array(HOME) + 0.2
    spec = make_scene("bare", 0, "panda")
    twin, full = TwinPlant(spec, TWIN_PANDA), Plant(spec, PANDA)
    twin.set_configuration(q)
    full.set_configuration(q)
    twin.advance()
    for name, pose in full.link_poses().items():
        assert np.allclose(twin.link_poses()[name].position, pose.position, atol=1e-9), name


def test_fingers_stop_at_the_object_and_carry_it():
    twin = make_twin()
    half_width = 0.02
    grip(twin)
    assert twin.carried_object == "red_cube"
    assert min(twin.read().finger_forces) == FORCE
    assert twin.read().opening == pytest.approx(half_width, abs=1e-3)
    tool, _ = twin.tool_pose()
    offset = np.array(twin.true_pose("red_cube").position) - tool
    twin.write(Command(np.full(PANDA.n, 0.1), CLOSED, FORCE))
    twin.advance()
    moved, _ = twin.tool_pose()
    assert not np.allclose(moved, tool)
    twin.write(Command(np.zeros(PANDA.n), CLOSED, FORCE))
    twin.advance()
    assert np.linalg.norm(np.array(twin.true_pose("red_cube").position) - moved - offset) < 2e-3


def test_fingers_that_close_on_nothing_close_completely():
    twin = make_twin()
    hold_fingers(twin, CLOSED)
    assert twin.carried_object is None
    assert twin.read().opening == pytest.approx(0.0, abs=1e-6)
    assert twin.read().finger_forces == (0.0, 0.0)


@pytest.mark.parametrize("spot", ["table", "bowl"])
def test_a_released_object_rests_on_the_surface_below(spot):
    twin = make_twin()
    grip(twin)
    bowl = np.array(twin.true_pose("blue_bowl").position)
    above = np.array([0.45, -0.2, 0.25]) if spot == "table" else bowl + np.array([0.0, 0.0, 0.2])
    twin.set_configuration(top_down_posture(twin, above, 0.0), twin.read().opening)
    hold_fingers(twin, CLOSED, 0.1)
    hold_fingers(twin, OPEN)
    obj = twin.spec.find("red_cube")
    surface = 0.0 if spot == "table" else BOWL_BOTTOM
    assert twin.carried_object is None
    assert twin.true_pose("red_cube").position[2] == pytest.approx(surface + obj.shape.half_extents[2], abs=2e-3)
    assert np.allclose(twin.true_pose("red_cube").position[:2], above[:2], atol=0.01)


def test_the_person_follows_its_path():
    twin = make_twin("forearm", 3)
    assert twin.spec.mover is not None
    path, start = person_path(twin.spec.mover), np.array(twin.true_pose(twin.spec.mover.name).position)
    first, _ = path.state_at(0.0)
    for _ in range(300):
        twin.advance()
    distance, rate = path.state_at(twin.now)
    expected = start + (distance - first) * path.direction
    assert np.allclose(twin.true_pose(twin.spec.mover.name).position, expected, atol=1e-9)
    assert np.allclose(twin.object_velocity(twin.spec.mover.name), rate * path.direction)


@pytest.mark.parametrize(
    ("shape", "direction", "expected"),
    [
        (Box((0.1, 0.2, 0.3)), (0.0, 0.6, 0.8), 0.36),
        (Sphere(0.05), (0.6, 0.0, 0.8), 0.05),
        (Cylinder(0.03, 0.1), (0.6, 0.0, 0.8), 0.098),
        (Capsule(0.03, 0.1), (0.6, 0.0, 0.8), 0.11),
    ],
    ids=["box", "sphere", "cylinder", "capsule"],
)
def test_half_extents_are_support_functions(shape, direction, expected):
    assert half_extent(shape, np.array(direction)) == pytest.approx(expected)


@pytest.mark.parametrize("shape", [Bowl(0.1, 0.05, 0.004), HalfSpace()], ids=["bowl", "half space"])
def test_hollow_shapes_have_no_extent(shape):
    with pytest.raises(TypeError, match="not a solid shape"):
        half_extent(shape, np.array([0.0, 0.0, 1.0]))


def test_the_model_of_the_twin_differs_in_period_and_sensing_only():
    panda = load_robot("panda")
    twin = twin_model(panda)
    assert twin.period == TWIN_PERIOD
    assert twin.force_sensing is None
    assert msgspec.structs.replace(twin, period=panda.period, force_sensing=panda.force_sensing) == panda
