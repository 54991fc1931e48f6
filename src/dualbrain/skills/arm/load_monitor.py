"""Load monitor: detects within 0.2 s that a held object was lost, removed, or slips in the fingers.

It uses the finger forces, the finger opening and the perceived position of the object, never the true state. A load is
lost once a finger has not pressed, or the fingers have pressed on each other, for `LOSS_TIME`, or once they have closed
by more than `MAX_CLOSING` within `MAX_AGE`; an object that is gripped askew turns slowly and is still held while both
fingers press. A load slips once its perceived position in the tool frame differs from that at the grasp by more than
`MAX_SLIP` beyond the errors of both measurements.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import FailureCause, SceneObject
from dualbrain.robots.interface import RobotState
from dualbrain.skills.skill import Observation

Array = NDArray[np.float64]

MIN_GRIP_FORCE = 0.5
"""Force on each finger that counts as contact [N] (two-finger test)."""
EMPTY_OPENING = 5e-4
"""Opening per finger [m] below which the fingers press on each other and not on an object."""
DETECTION_TIME = 0.2
"""Bound of the time [s] between the loss of a load and its detection."""
LOSS_TIME = 0.1
"""Time [s] without force on both fingers after which a load is lost; shorter interruptions are vibration."""
MAX_CLOSING = 0.004
"""Closing of each finger [m] within `MAX_AGE` beyond which nothing is left between the fingers."""
MAX_SLIP = 0.010
"""Displacement [m] of the load in the tool frame, beyond the perception errors, that counts as slip."""
MAX_AGE = 0.2
"""Time [s] for which tool poses and openings are stored; a perceived position that is older is not compared."""


@dataclass(frozen=True, slots=True)
class LoadEvent:
    """A change of the load: the object `name` was lost, or (`slip` [m] > 0) moved in the fingers and is still held."""

    name: str
    slip: float = 0.0

    @property
    def cause(self) -> FailureCause:
        """The cause of the failure of a step during which the load changed."""
        return FailureCause.LOAD_SLIPPED if self.slip else FailureCause.LOAD_LOST

    def describe(self) -> str:
        """The change in words, as the reason of a failed step."""
        if self.slip:
            return f"{self.name} slipped {self.slip * 1000:.0f} mm in the fingers and is still held"
        return f"{self.name} was lost: the fingers do not press on it any more"


@dataclass(frozen=True, slots=True)
class _ToolPose:
    time: float
    position: Array
    rotation: Array
    opening: float | None


class LoadMonitor:
    """Monitor of the load of one gripper. State: the load, its position in the tool frame, the recent tool poses."""

    def __init__(self) -> None:
        """Start without a load."""
        self.name = ""
        self._offset: Array | None = None
        self._offset_error = 0.0
        self._pressed_at = self._compared = 0.0
        self._poses: deque[_ToolPose] = deque()

    def watch(self, obj: SceneObject, offset: Array | None, observation: Observation) -> None:
        """Monitor `obj` from now on; `offset` (3,) [m] is its position in the tool frame, None if it is not known."""
        self.name, self._offset, self._offset_error = obj.name, offset, obj.error
        self._poses.clear()
        self._pressed_at, self._compared = observation.now, obj.stamp

    def forget(self) -> None:
        """The load was released, or is not to be monitored."""
        self.name, self._offset = "", None

    def forget_motion(self) -> None:
        """Drop the stored tool poses, because the frame of the observations has changed."""
        self._poses.clear()

    def update(self, observation: Observation) -> LoadEvent | None:
        """The change of the load that this observation shows, if there is one; a lost load is not monitored further."""
        if not self.name:
            return None
        self._store_pose(observation)
        lost, slip = self._is_lost(observation), self._slip(observation)
        if lost or (slip and not press_on_object(observation.state)):
            event = LoadEvent(self.name)
            self.forget()
            return event
        return LoadEvent(self.name, slip) if slip else None

    def _is_lost(self, observation: Observation) -> bool:
        now = observation.now
        if press_on_object(observation.state):
            self._pressed_at = now
        first, last = (_first_known(poses) for poses in (self._poses, reversed(self._poses)))
        closed = first is not None and last is not None and first - last > MAX_CLOSING
        return closed or now - self._pressed_at > LOSS_TIME

    def _store_pose(self, observation: Observation) -> None:
        tool, now = observation.tool, observation.now
        if not self._poses or now > self._poses[-1].time:
            self._poses.append(_ToolPose(now, tool.position, tool.rotation, observation.state.opening))
        while now - self._poses[0].time > MAX_AGE:
            self._poses.popleft()

    def _slip(self, observation: Observation) -> float:
        """Displacement of the load in the tool frame [m] by a new measurement; 0 within the errors or without one."""
        obj = next((one for one in observation.scene.objects if one.name == self.name), None)
        if obj is None or self._offset is None or obj.stamp <= self._compared or obj.stamp < self._poses[0].time:
            return 0.0
        self._compared = obj.stamp
        pose = min(self._poses, key=lambda one: abs(one.time - obj.stamp))
        offset = offset_in_tool(obj, pose.position, pose.rotation)
        distance = float(np.linalg.norm(offset - self._offset))
        if distance <= MAX_SLIP + obj.error + self._offset_error:
            return 0.0
        self._offset, self._offset_error = offset, obj.error
        return distance


def _first_known(poses: Iterable[_ToolPose]) -> float | None:
    return next((one.opening for one in poses if one.opening is not None), None)


def press_on_object(state: RobotState) -> bool:
    """Whether both fingers press on an object (two-finger test), and not on each other."""
    apart = state.opening is None or state.opening >= EMPTY_OPENING
    return apart and min(state.finger_forces) >= MIN_GRIP_FORCE


def offset_in_tool(obj: SceneObject, position: Array, rotation: Array) -> Array:
    """The position (3,) [m] of `obj` in the frame of a tool at `position` with `rotation` (3, 3)."""
    return rotation.T @ (np.asarray(obj.pose.position) - position)
