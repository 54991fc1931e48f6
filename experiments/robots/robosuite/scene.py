"""The suite's objects as the filter's obstacles, and the contacts permitted at each waypoint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.records import SceneObject
from dualbrain.safety.cbf.filter import Contact, Obstacle, SafetyFilter, ToolState
from dualbrain.safety.cbf.grasped_object import cover_with_spheres
from experiments.robots.robosuite.policies import Waypoint
from experiments.robots.robosuite.suite_process import State, SuiteObject

CUBE_MARGIN = 0.001
"""Margin around cubes, which are observed every 20 ms and may have been pushed in between [m]."""
HELD_POSITION_ERROR = 0.002
"""Largest slip of a cube between the fingers [m]."""
GRASP_CONTACT_SPEED, PLACE_CONTACT_SPEED = 0.2, 0.1
"""Contact speeds of the fingers with the cube to be grasped, and of a held cube with its support [m/s]."""
TABLE_CONTACT_HEIGHT = 0.02
"""Below this height, a held cube may touch the table [m]."""
HELD_DISTANCE = 0.02
"""The cube counts as held if the fingers are closed and its centre is this close to the tool [m]."""


def static_obstacles(objects: Sequence[SuiteObject]) -> tuple[Obstacle, ...]:
    """All fixed objects: table, mount, floor."""
    return tuple(_obstacle(one, i) for i, one in enumerate(objects) if not one.name.startswith("cube"))


def _obstacle(one: SuiteObject, index: int) -> Obstacle:
    pose, name = Pose(one.position, one.quaternion), f"{one.name}{index}" if one.name == "mount" else one.name
    match one.solid:
        case "plane":
            return Obstacle(name, HalfSpace(), pose)
        case "cylinder":
            radius, half = one.size[:2]
            return Obstacle(name, Box((radius, radius, half)), pose)
        case _:
            return Obstacle(name, Box(one.size), pose)


class ObstacleTracker:
    """Keeps the filter's obstacles, permitted contacts and held object up to date; nothing is tuned to a seed."""

    def __init__(self, safety: SafetyFilter, objects: Sequence[SuiteObject]) -> None:
        """`safety` already has the static obstacles."""
        self._safety = safety
        self._sizes = {one.name: one.size for one in objects if one.name.startswith("cube")}
        self._target = min(self._sizes)
        table = next(one for one in objects if one.name == "table")
        self._table = table.position[2] + table.size[2]
        self._held = False
        self._was_closed = False

    def update(self, state: State, tool: ToolState, point: Waypoint) -> None:
        """Update the filter's obstacles, held object and permitted contacts."""
        cube = state.cubes[self._target]
        near = float(np.linalg.norm(np.array(cube.position) - tool.position)) <= HELD_DISTANCE
        held = self._was_closed and point.closed and near
        if held and not self._held:
            box = SceneObject(name=self._target, role="object", shape=Box(self._sizes[self._target]), pose=cube)
            self._safety.attach(cover_with_spheres(box, tool.position, tool.rotation), HELD_POSITION_ERROR)
        if self._held and not held:
            self._safety.detach()
        self._held = held
        self._was_closed = point.closed and point.name != "close"
        free = [name for name in self._sizes if not (held and name == self._target)]
        self._safety.observe(
            [Obstacle(name, Box(self._sizes[name]), state.cubes[name], margin=CUBE_MARGIN) for name in free], state.time
        )
        self._safety.permit(self._permitted_contacts(cube, point))

    def _permitted_contacts(self, cube: Pose, point: Waypoint) -> list[Contact]:
        if not self._held:
            return [Contact("fingers", self._target, GRASP_CONTACT_SPEED)]
        height = cube.position[2] - self._sizes[self._target][2] - self._table
        permits = [Contact("held", "table", PLACE_CONTACT_SPEED)] if height < TABLE_CONTACT_HEIGHT else []
        return [*permits, Contact("held", point.may_touch, PLACE_CONTACT_SPEED)] if point.may_touch else permits
