"""The state at the end of a run on simulator ground truth, as data: a judgement can be made again from a stored row."""

from __future__ import annotations

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Vector
from dualbrain.simulation.monitoring.contact_rules import ContactRules
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.multi_goal import HomeJudge
from dualbrain.skills.kinematics.object_geometry import half_height

MAX_STATIC_SPEED = 0.02
"""An object below this speed is at rest [m/s]."""


class ObjectState(msgspec.Struct, frozen=True, kw_only=True):
    """One movable object: position at the start and the end [m], number of touching fingers, whether it is at rest.

    `lowest` [m] is the height of its lowest point at the end, None in rows that were stored without it.
    """

    start: Vector
    end: Vector
    fingers: int
    at_rest: bool
    lowest: float | None = None


class FinalState(msgspec.Struct, frozen=True, kw_only=True):
    """The end of a run: objects by name, tool position [m], and the motion of the robot.

    `joint_motion` [rad] and `base_motion` [m] are the largest distances from the initial posture during the run. `turn`
    [rad] is the rotation of a base, counter-clockwise. `broken` names the fragile objects that were loaded too much.
    """

    objects: dict[str, ObjectState]
    tool: Vector
    home: bool
    ground: tuple[float, float]
    joint_motion: float = 0.0
    base_motion: float = 0.0
    turn: float = 0.0
    broken: tuple[str, ...] = ()


class MotionRecorder:
    """Records the initial state of a plant and the largest motion of the robot; call `update` in every snapshot."""

    def __init__(self, plant: Plant) -> None:
        """Record the present state as the initial one."""
        self._plant = plant
        self._names = tuple(obj.name for obj in plant.spec.objects if not obj.fixed)
        self._start = {name: plant.true_pose(name).position for name in self._names}
        self._q, self._ground = self._joints(), np.array(plant.ground_position(), float)
        self._is_base = plant.robot_model.is_mobile
        self._joint_motion = self._base_motion = 0.0

    def update(self) -> None:
        """Record the present motion."""
        if self._is_base:
            moved = np.linalg.norm(np.subtract(self._plant.ground_position(), self._ground))
            self._base_motion = max(self._base_motion, float(moved))
        self._joint_motion = max(self._joint_motion, float(np.max(np.abs(self._joints() - self._q), initial=0.0)))

    def final_state(self) -> FinalState:
        """The present state as the final one."""
        self.update()
        plant = self._plant
        x, y = np.array(plant.ground_position(), float).tolist()
        tool = (x, y, 0.0) if self._is_base_alone() else plant.tool_pose()[0].tolist()
        return FinalState(
            objects={name: self._object_state(name) for name in self._names},
            tool=(float(tool[0]), float(tool[1]), float(tool[2])),
            home=not self._is_base_alone() and HomeJudge(plant).score()[0],
            ground=(x, y),
            joint_motion=self._joint_motion,
            base_motion=self._base_motion,
            turn=float(self._joints()[2] - self._q[2]) if self._is_base_alone() else 0.0,
        )

    def _is_base_alone(self) -> bool:
        return self._is_base and not self._plant.robot_model.is_mobile_manipulator

    def _joints(self) -> np.ndarray:
        return np.array(self._plant.data.qpos[self._plant.arm_slices[0]], float)

    def _object_state(self, name: str) -> ObjectState:
        plant = self._plant
        pose = plant.true_pose(name)
        return ObjectState(
            start=self._start[name],
            end=pose.position,
            fingers=count_touching_fingers(plant, name),
            at_rest=bool(np.linalg.norm(plant.object_velocity(name)) < MAX_STATIC_SPEED),
            lowest=pose.position[2] - half_height(plant.spec.find(name).shape, pose),
        )


def count_touching_fingers(plant: Plant, name: str) -> int:
    """Number of fingers in contact with the object `name`."""
    rules, fingers = ContactRules(plant.model, plant.spec), set[str]()
    for first, second in plant.data.contact.geom.tolist():
        for one, other in ((first, second), (second, first)):
            if rules.owners[one] == name and rules.finger_mask[other]:
                fingers.add(rules.owners[other])
    return len(fingers)
