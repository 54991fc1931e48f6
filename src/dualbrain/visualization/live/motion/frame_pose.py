"""Pose of a scene frame, of which only visible changes are sent to the pages.

The setters of viser compare every value with numpy, which takes nine tenths of their time (27 µs). This module has
compared already, so it queues the messages of viser itself where the installed version permits it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, dist
from typing import TYPE_CHECKING, Any

from dualbrain.core.geometry.shapes import IDENTITY_POSE, Pose, Quaternion, Vector

if TYPE_CHECKING:
    from viser import FrameHandle

VISIBLE_MOTION_M, VISIBLE_TURN_RAD = 5e-4, 1e-3
"""Smallest motion [m] and smallest turn [rad] that are visible; a pixel is about 2 mm."""


class FramePose:
    """The pose that all pages show of one scene frame."""

    def __init__(self, frame: FrameHandle, visible_turn: float = VISIBLE_TURN_RAD) -> None:
        """A new `frame`, at the identity; a turn below `visible_turn` [rad] is not sent."""
        self._send_position, self._send_orientation = pose_senders(frame)
        self._least_cosine = cos(0.5 * visible_turn)
        self._position, self._quaternion = IDENTITY_POSE.position, IDENTITY_POSE.quaternion

    def show(self, pose: Pose) -> None:
        """Send the position or the orientation of `pose` if it differs visibly from the shown one."""
        if dist(self._position, pose.position) > VISIBLE_MOTION_M:
            self._position = pose.position
            self._send_position(pose.position)
        if abs(_dot(self._quaternion, pose.quaternion)) < self._least_cosine:
            self._quaternion = pose.quaternion
            self._send_orientation(pose.quaternion)


def pose_senders(frame: Any) -> tuple[Callable[[Vector], None], Callable[[Quaternion], None]]:
    """Functions that send a position [m] and an orientation of `frame` without a comparison.

    They are the setters of `frame` for a version of viser with other messages.
    """
    try:
        from viser._messages import SetOrientationMessage, SetPositionMessage  # noqa: PLC0415  (viser is heavy)

        queue, name = frame._impl.api._queue_scene_message, frame.name
    except (ImportError, AttributeError):
        return lambda position: setattr(frame, "position", position), lambda turn: setattr(frame, "wxyz", turn)
    return lambda position: queue(SetPositionMessage(name, position)), lambda turn: queue(
        SetOrientationMessage(name, turn)
    )


def _dot(one: Quaternion, other: Quaternion) -> float:
    return sum(a * b for a, b in zip(one, other, strict=True))
