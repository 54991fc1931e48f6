"""Scene frames of the links of a robot, each within the frame of the link before it.

A joint that turns then changes one value, the orientation of its link relative to the link before it. With all frames
in the world it would change two, the position and the orientation, of every link behind it. Each changed value is a
message to every open page.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from dualbrain.core.geometry.shapes import IDENTITY_POSE, Pose, Quaternion, Vector
from dualbrain.robots.model import Link, RobotModel
from dualbrain.visualization.live.motion.frame_pose import FramePose

if TYPE_CHECKING:
    from viser import SceneApi

VISIBLE_TURN_RAD = 2e-4
"""Smallest turn [rad] relative to the link before that is drawn.

Such turns in all seven joints of an arm move its tool by less than 1.5 mm, which is less than a pixel.
"""


class LinkFrames:
    """The frames of all links of a robot below one scene node; `paths` has the name of each scene node by link."""

    def __init__(self, scene: SceneApi, root: str, robot_model: RobotModel) -> None:
        """Add the frames below the node `root`, at the identity."""
        self._parents = links_before(robot_model.links)
        self._poses: dict[str, Pose] = {}
        self._frames: dict[str, FramePose] = {}
        self.paths: dict[str, str] = {}
        for name, parent in self._parents.items():
            self.paths[name] = f"{self.paths.get(parent, root)}/{name}"
            self._frames[name] = FramePose(scene.add_frame(self.paths[name], show_axes=False), VISIBLE_TURN_RAD)

    def update(self, poses: Mapping[str, Pose]) -> None:
        """Show the `poses` in the world; a link without one keeps its pose relative to the link before it."""
        self._poses.update(poses)
        for name, parent in self._parents.items():
            if name in poses:
                self._frames[name].show(relative_pose(self._poses.get(parent, IDENTITY_POSE), poses[name]))


def links_before(links: tuple[Link, ...]) -> dict[str, str]:
    """The link before each link in the chain, "" for the first one, in an order in which it comes before its link.

    Links on the same chain frame (hand and fingers) follow the first link on it.
    """
    parents: dict[str, str] = {}
    first_by_frame: dict[int, str] = {}
    for link in sorted(links, key=lambda one: one.frame):
        earlier = [name for frame, name in first_by_frame.items() if frame <= link.frame]
        parents[link.name] = earlier[-1] if earlier else ""
        first_by_frame.setdefault(link.frame, link.name)
    return parents


def relative_pose(reference: Pose, pose: Pose) -> Pose:
    """`pose` as seen from the frame `reference`, both with unit quaternions: T_reference⁻¹ T_pose.

    Plain numbers, because arrays of this size take several times as long.
    """
    w, *axis = reference.quaternion
    x, y, z = (-one for one in axis)
    a, b, c, d = pose.quaternion
    turn = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    (px, py, pz), (rx, ry, rz) = pose.position, reference.position
    return Pose(_rotate((w, x, y, z), (px - rx, py - ry, pz - rz)), turn)


def _rotate(quaternion: Quaternion, vector: Vector) -> Vector:
    """`vector` turned by a unit quaternion: v + 2 w (r × v) + 2 r × (r × v)."""
    w, x, y, z = quaternion
    u, v, t = vector
    a, b, c = 2.0 * (y * t - z * v), 2.0 * (z * u - x * t), 2.0 * (x * v - y * u)
    return (u + w * a + y * c - z * b, v + w * b + z * a - x * c, t + w * c + x * b - y * a)
