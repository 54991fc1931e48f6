"""What the suite says stands there, as the filter's obstacles, and what the script may touch at each way point."""

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
"""Kept around cubes: they are looked at anew every 20 ms, and may have been pushed meanwhile [m]."""
HELD_POSITION_ERROR = 0.002
"""How far a cube may slip between the fingers [m]."""
GRASP_CONTACT_SPEED, PLACE_CONTACT_SPEED = 0.2, 0.1
"""How fast fingers may meet the cube they take, and a held cube what it stands on [m/s]."""
TABLE_CONTACT_HEIGHT = 0.02
"""Below this height a held cube still leaves the table, and may touch it [m]."""
HELD_DISTANCE = 0.02
"""The cube is held when the fingers have closed and its middle is this near to the tool [m]."""


def static_obstacles(things: Sequence[SuiteObject]) -> tuple[Obstacle, ...]:
    """Everything that stays: table, mount, floor."""
    return tuple(_obstacle(thing, i) for i, thing in enumerate(things) if not thing.name.startswith("cube"))


def _obstacle(thing: SuiteObject, index: int) -> Obstacle:
    pose, name = Pose(thing.position, thing.quaternion), f"{thing.name}{index}" if thing.name == "mount" else thing.name
    match thing.solid:
        case "plane":
            return Obstacle(name, HalfSpace(), pose)
        case "cylinder":
            radius, half = thing.size[:2]
            return Obstacle(name, Box((radius, radius, half)), pose)
        case _:
            return Obstacle(name, Box(thing.size), pose)


class ObstacleTracker:
    """Keeps the filter's obstacles, permits and held thing as the script goes on; nothing of it is tuned to a seed."""

    def __init__(self, safety: SafetyFilter, things: Sequence[SuiteObject]) -> None:
        """`safety` already has what stands there."""
        self._safety = safety
        self._sizes = {thing.name: thing.size for thing in things if thing.name.startswith("cube")}
        self._target = min(self._sizes)
        table = next(thing for thing in things if thing.name == "table")
        self._table = table.position[2] + table.size[2]
        self._held = False
        self._was_closed = False

    def update(self, state: State, tool: ToolState, point: Waypoint) -> None:
        """Tell the filter what is where now, and what may be touched."""
        cube = state.cubes[self._target]
        near = float(np.linalg.norm(np.array(cube.position) - tool.position)) <= HELD_DISTANCE
        taken = self._was_closed and point.closed and near
        if taken and not self._held:
            box = SceneObject(name=self._target, role="object", shape=Box(self._sizes[self._target]), pose=cube)
            self._safety.attach(cover_with_spheres(box, tool.position, tool.rotation), HELD_POSITION_ERROR)
        if self._held and not taken:
            self._safety.detach()
        self._held = taken
        self._was_closed = point.closed and point.name != "close"
        seen = [name for name in self._sizes if not (taken and name == self._target)]
        self._safety.observe(
            [Obstacle(name, Box(self._sizes[name]), state.cubes[name], margin=CUBE_MARGIN) for name in seen], state.time
        )
        self._safety.permit(self._permitted_contacts(cube, point))

    def _permitted_contacts(self, cube: Pose, point: Waypoint) -> list[Contact]:
        if not self._held:
            return [Contact("fingers", self._target, GRASP_CONTACT_SPEED)]
        over = cube.position[2] - self._sizes[self._target][2] - self._table
        permits = [Contact("held", "table", PLACE_CONTACT_SPEED)] if over < TABLE_CONTACT_HEIGHT else []
        return [*permits, Contact("held", point.may_touch, PLACE_CONTACT_SPEED)] if point.may_touch else permits
