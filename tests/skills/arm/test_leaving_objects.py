"""Yielding to a person: the hand first leaves an object that it may touch, in the same phase and along its axis."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.records import ObjectLimits, Scene, SceneObject
from dualbrain.skills.arm import grasp
from dualbrain.skills.arm.controller import LEAVING_TIMEOUT, YIELD_SPEED, YIELDED
from dualbrain.skills.kinematics.object_geometry import CLEARANCE, part_clearance
from dualbrain.skills.skill import HeldObject, Observation
from dualbrain.skills.time_slicing import run_to_completion
from tests.skills.arm.test_blocked_waypoints import BODY, TABLE, KinematicCell

LEAN = np.deg2rad(30.0)
AXIS = np.array([np.sin(LEAN), 0.0, -np.cos(LEAN)])
"""Approach axis (3,) of the hand."""
START = np.array([0.5, 0.0, 0.12])
"""Position (3,) of the tool around the cube [m]."""


class CellWithCube(KinematicCell):
    """A hand with open fingers around a block in the air, and a person who is near until `person_until` [s]."""

    def __init__(self, person_until=0.0):
        cube = SceneObject(name="cube", role="object", shape=Box((0.02, 0.034, 0.02)), pose=Pose(tuple(START)))
        self.scene = Scene(robot="panda", stamp=0.0, version=1, objects=(TABLE, cube))
        super().__init__()
        side = np.array([0.0, 1.0, 0.0])
        grasp_rotation = np.column_stack([np.cross(side, AXIS), side, AXIS])
        posture = run_to_completion(self.controller.find_goal(START, [grasp_rotation])).posture
        self.state = replace(self.state, q=posture, opening=0.04)
        self.path = []
        self.observe()
        self.controller.begin(grasp.spec(BODY), target="cube", support="table")
        self.controller.person_threat_height = lambda *_, **__: 0.3 if self.now < person_until else None

    def observe(self):
        tool = self.safety.tool(self.state.q)
        self.controller.observe(
            Observation(state=self.state, scene=self.scene, now=self.now, tool=tool, paused_time=self.paused)
        )
        self.path.append(tool.position.copy())

    def finger_clearance(self):
        """Distance [m] of the fingers from the cube."""
        return part_clearance(self.scene.objects[1], "fingers", *self.safety.spheres(self.state.q, self.state.opening))


@pytest.mark.parametrize("person_until", [0.05, 2.0])
def test_an_open_hand_leaves_along_its_axis_before_it_yields(person_until):
    cell = CellWithCube(person_until)
    routine, places = cell.controller.avoid_person("descend", 0.3), {"descend": [], "yield": []}

    def watched():
        try:
            while True:
                nominal = next(routine)
                places[nominal.phase].append((cell.path[-1] - START, cell.finger_clearance()))
                assert ("fingers", "cube") in {(one.robot_part, one.obstacle) for one in nominal.contacts}
                yield nominal
        except StopIteration as end:
            return end.value

    assert cell.carry_out(watched()) is YIELDED
    assert cell.phases == (["descend", "yield"] if person_until > 1.0 else ["descend"])
    assert cell.finger_clearance() >= CLEARANCE
    assert all(clear >= CLEARANCE for _, clear in places["yield"][:1])
    moved, clear = places["descend"][-1]
    assert clear < CLEARANCE
    along = -moved @ AXIS
    assert along > 0.02
    assert np.linalg.norm(moved + along * AXIS) < 0.1 * along
    assert abs(moved[1]) < 0.002  # the direction in which the fingers close


def assert_straight_up(moved):
    assert moved[2] > 0.1
    assert np.linalg.norm(moved[:2]) < 0.1 * moved[2]


def test_a_hand_that_touches_nothing_yields_at_once():
    cell = CellWithCube(person_until=1.0)
    assert cell.carry_out(cell.controller.avoid_person("approach", 0.3)) is YIELDED
    assert cell.phases == ["yield"]
    assert_straight_up(cell.path[-1] - cell.path[0])


@pytest.mark.parametrize("holding", [True, False])
def test_fingers_that_press_on_the_object_rise_straight_up(holding):
    cell = CellWithCube(person_until=1.0)
    cell.state = replace(cell.state, finger_forces=(5.0, 5.0))
    cell.controller.holding = HeldObject("cube", 0.02) if holding else None
    cell.observe()
    assert cell.carry_out(cell.controller.avoid_person("close", 0.3)) is YIELDED
    assert cell.phases[0] == ("yield" if holding else "close")
    assert_straight_up(cell.path[-1] - cell.path[0])


@pytest.mark.parametrize("limit", [0.05, 0.1, None])
def test_a_hand_with_an_object_yields_within_the_speed_limit_of_the_object(limit):
    cell = CellWithCube(person_until=1.0)
    table, cube = cell.scene.objects
    held = msgspec.structs.replace(cube, limits=ObjectLimits(speed=limit))
    cell.scene = msgspec.structs.replace(cell.scene, objects=(table, held))
    cell.state = replace(cell.state, finger_forces=(5.0, 5.0))
    cell.controller.holding = HeldObject("cube", 0.02)
    cell.observe()
    assert cell.carry_out(cell.controller.avoid_person("carry", 0.3)) is YIELDED
    fastest = np.linalg.norm(np.diff(cell.path, axis=0), axis=1).max() / BODY.period
    assert fastest > 0.8 * (limit or YIELD_SPEED)
    assert limit is None or fastest <= limit


def test_a_hand_that_cannot_leave_yields_after_the_timeout():
    cell = CellWithCube(person_until=0.05)
    routine, fixed, times = cell.controller.avoid_person("descend", 0.3), cell.state, []
    for nominal in routine:
        times.append((cell.now, nominal.phase))
        cell.now += BODY.period
        cell.state = replace(fixed, stamp=cell.now, sequence=len(times))
        cell.observe()
    assert {phase for _, phase in times} == {"descend"}
    assert times[-1][0] == pytest.approx(LEAVING_TIMEOUT, abs=0.01)
