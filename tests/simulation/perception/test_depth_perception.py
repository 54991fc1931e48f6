"""Perception from pictures alone: what stands on the table is found and named, and is where it is said to be."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Pose
from dualbrain.errors import ConfigurationError
from dualbrain.simulation.perception.depth_perception import SURFACE_ERROR_BOUND, DepthPerception, shape_category
from dualbrain.simulation.perception.primitive_fitting import Primitive
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from tests.simulation.perception.test_primitive_fitting import box_points, rendered_colour, ring_points
from tests.simulation.perception.test_rendering import run_program
from tests.simulation.scripted_hand import make_plant, pick_up, wait, yaw_of

LOOK = """
import numpy as np
from dualbrain.simulation.perception.depth_camera import DepthCamera
from dualbrain.simulation.perception.depth_perception import SURFACE_ERROR_BOUND, DepthPerception
from tests.simulation.scripted_hand import make_plant, wait
p = make_plant("tabletop", 1)
with DepthCamera(p) as camera:
    perception = DepthPerception(p.spec, camera)
    scene = perception.perceive(p)
    seen = {thing.name: thing for thing in scene.objects}
    assert set(seen) == {"table", *(thing.name for thing in p.spec.objects)}, sorted(seen)
    for thing in p.spec.objects:
        off = np.subtract(seen[thing.name].pose.position, p.true_pose(thing.name).position)
        assert np.linalg.norm(off) < SURFACE_ERROR_BOUND, (thing.name, off)
        assert type(seen[thing.name].shape) is type(thing.shape)
    assert perception.perceive(p).find("red_cube") == scene.find("red_cube"), "no new picture within its period"
    wait(p, 0.6)
    again = {thing.name: thing for thing in perception.perceive(p).objects}
    renewed = [name for name in seen if again[name].stamp > seen[name].stamp and again[name].error > 0.0]
    assert renewed
    assert all(again[name].pose != seen[name].pose for name in renewed), "a second picture is never equal to the bit"
"""


class Eyes:
    """A camera that sees the cube and the bowl of a bare scene from everywhere, or nothing while `shut`."""

    def __init__(self, plant):
        self.plant, self.shut, self.hidden = plant, False, 0.0

    def capture_points(self, min_height):
        del min_height
        if self.shut:
            return np.zeros((0, 3)), np.zeros((0, 3))
        at, bowl = (np.array(self.plant.true_pose(name).position) for name in ("red_cube", "blue_bowl"))
        cube = box_points((0.02, 0.02, 0.025), at[:2], yaw_of(self.plant.true_pose("red_cube")))
        parts = ((cube, "red"), (ring_points(0.085, 0.05, bowl[:2], floor=0.008), "blue"))
        colours = [np.tile(rendered_colour(colour), (len(points), 1)) for points, colour in parts]
        points, colours = np.vstack([points for points, _ in parts]), np.vstack(colours)
        shown_of_cube = points[:, 0] < at[0] + 0.02 - self.hidden
        kept = shown_of_cube | (np.linalg.norm(points[:, :2] - at[:2], axis=1) > 0.05)
        return points[kept], colours[kept]


def test_a_table_is_seen_as_it_stands():
    code, said = run_program(LOOK, MUJOCO_GL="egl")
    if "MissingDependencyError" in said:
        code, said = run_program(LOOK, MUJOCO_GL="osmesa")
    assert code == 0, said


def test_what_moved_is_seen_where_it_went_and_what_is_hidden_stays():
    p = make_plant("bare", 1)
    camera = Eyes(p)
    eyes = DepthPerception(p.spec, camera)
    first = eyes.perceive(p).find("red_cube")
    p.data.joint("red_cube").qpos[0] += 0.05
    wait(p, 0.3)
    assert eyes.perceive(p).find("red_cube") == first, "no new picture yet"
    camera.shut = True
    wait(p, 0.3)
    assert eyes.perceive(p).find("red_cube") == first, "hidden"
    camera.shut = False
    wait(p, 0.6)
    again = eyes.perceive(p).find("red_cube")
    assert again.pose.position[0] == pytest.approx(first.pose.position[0] + 0.05, abs=SURFACE_ERROR_BOUND)
    assert again.stamp > first.stamp


def test_what_is_hidden_in_part_is_as_large_as_it_was_and_where_it_was():
    """Of a cube whose edge nobody sees a smaller one is fitted, farther off: a hand would run into it."""
    p = make_plant("bare", 1)
    camera = Eyes(p)
    eyes = DepthPerception(p.spec, camera)
    first = eyes.perceive(p).find("red_cube")
    camera.hidden = 0.005
    wait(p, 0.6)
    assert eyes.perceive(p).find("red_cube") == first
    camera.hidden = 0.0
    wait(p, 0.6)
    assert eyes.perceive(p).find("red_cube").stamp > first.stamp


def test_what_is_held_moves_with_the_hand_though_nobody_sees_it():
    p = make_plant("bare", 1)
    camera = Eyes(p)
    eyes = DepthPerception(p.spec, camera)
    bowl = eyes.perceive(p).find("blue_bowl")
    camera.shut = True
    pick_up(p, "red_cube", each=lambda: eyes.perceive(p))
    scene = eyes.perceive(p)
    held = scene.find("red_cube").pose.position
    assert held[2] > 0.1
    assert np.linalg.norm(np.subtract(held, p.true_pose("red_cube").position)) < 2 * SURFACE_ERROR_BOUND
    assert scene.find("blue_bowl") == bowl


def test_people_and_rooms_are_refused():
    with pytest.raises(ConfigurationError, match="without people"):
        DepthPerception(make_scene("forearm", 0), camera=None)


def test_kinds_follow_shape_and_height():
    def kind(shape, colour="green"):
        return shape_category(Primitive(shape, Pose((0.0, 0.0, 0.0)), colour, 99))

    assert [kind(Cylinder(0.02, half)) for half in (0.03, 0.05, 0.09)] == ["tin", "can", "bottle"]
    assert [kind(Box((0.02, 0.02, half))) for half in (0.03, 0.05, 0.09)] == ["block", "carton", "box"]
    assert kind(Box((0.02, 0.02, 0.025)), "red") == "cube"
    assert kind(Cylinder(0.024, 0.045), "clear") == "glass"
    assert kind(Bowl(0.085, 0.05, 0.004), "blue") == "bowl"
