"""Foresight: how near the arm would come to what is perceived on a way it has not gone yet.

It chooses between ways of doing the same thing and promises nothing: the filter keeps its margins whatever was
foreseen. People are left out, because where they will be is `person`'s business.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dualbrain.embodiment.body import Body
from dualbrain.embodiment.solids import distance, solid
from dualbrain.linalg import rotation_error
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.skill import Motion, Touch

Array = NDArray[np.float64]

AIR = 0.004
"""A way counts as clear when the margins leave this much everywhere [m]."""
NEARER = 0.008
"""φ itself keeps off what it knows, and passes it this much nearer without being bent [m]."""
LEAVING = 4
"""Strides at the start of a way on which what is near already does not count."""
STRIDE = 0.012
"""Step of a rehearsal [m]; a turn of the tool counts as 10 cm per rad."""
LEVER, DRIFT = 0.1, 0.25
"""Lever [m] by which turns are counted, and how far the posture is pulled in a step at most [rad per 10 cm]."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A tool pose to reach: position (3,) [m], rotation (3, 3), and the joint posture (n,) [rad] that suits it."""

    position: Array
    rotation: Array
    posture: Array


T = TypeVar("T")


def clearest(choices: Iterable[T], air: Callable[[T], float]) -> tuple[T | None, float]:
    """The first choice whose way is clear, else the one with most `air` [m], and how much that is; None of nothing."""
    best, most = None, -np.inf
    for choice in choices:
        room = air(choice)
        if room > most:
            best, most = choice, room
        if most >= AIR:
            break
    return best, most


class Foresight:
    """Rehearses motions of one arm in its head."""

    def __init__(self, body: Body, motion: Motion) -> None:
        """Bind to the body and to the local layer's kinematics."""
        self._motion = motion
        self._redundant = body.n > 6
        self._lower = np.array([joint.lower.value for joint in body.joints])
        self._upper = np.array([joint.upper.value for joint in body.joints])
        frames = [link.frame for link in body.links for sphere in body.spheres if sphere.link == link.name]
        self._bolted = np.array(frames) == 0

    def way(self, q: Array, points: Sequence[Goal]) -> list[Array]:
        """Postures (n,) [rad] on the way from `q` through `points`, about a stride apart, the start included."""
        postures = [q]
        for point in points:
            postures += self._leg(postures[-1], point)
        return postures

    def clearance(
        self, postures: Sequence[Array], opening: float, scene: Scene, held: str | None, known: Collection[str] = (),
        touches: Collection[Touch] = (),
    ) -> float:  # fmt: skip
        """Least distance [m] between the body and what is perceived, beyond the errors, over all `postures`.

        What is `known` to φ may be `NEARER`, and does not count for a part that may touch it.
        """
        shown = [self._motion.spheres(q, opening) for q in postures]
        centres = np.array([centres for centres, _, _ in shown])
        _, radii, groups = shown[0]
        extra = next((thing.error for thing in scene.objects if thing.name == held), 0.0)
        reach = radii + np.array([extra if group == "held" else 0.0 for group in groups])
        base = np.zeros(len(groups), bool)
        base[: len(self._bolted)] = self._bolted
        least = np.inf
        for thing in scene.objects:
            if thing.role != "person" and thing.name != held:
                counts = ~base & ~_spared(thing, groups, touches)
                apart = distance(*solid(thing.shape, thing.pose), centres[:, counts]) - reach[counts]
                least = min(least, float(apart.min()) - thing.error + (NEARER if thing.name in known else 0.0))
        return least

    def _leg(self, q: Array, point: Goal) -> list[Array]:
        """Resolved-rate steps from `q` to `point`, as φ would take them, in strides."""
        postures: list[Array] = []
        for _ in range(120):
            tool = self._motion.tool(q)
            move, turn = point.position - tool.position, rotation_error(tool.rotation, point.rotation)
            ahead = float(np.linalg.norm(move)) + LEVER * float(np.linalg.norm(turn))
            if ahead < 0.25 * STRIDE:
                break
            share = min(1.0, STRIDE / ahead)
            pull = point.posture - q if self._redundant else np.zeros_like(q)
            pull *= min(1.0, DRIFT * share * ahead / LEVER / (float(np.linalg.norm(pull)) + 1e-9))
            J = tool.jacobian
            twist = share * np.concatenate([move, turn])
            q = q + pull + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), twist - J @ pull)
            q = np.clip(q, self._lower, self._upper)
            postures.append(q)
        return postures


def _spared(thing: SceneObject, groups: Sequence[str], touches: Collection[Touch]) -> NDArray[np.bool_]:
    """Which spheres may touch `thing`."""
    parts = {touch.robot_part for touch in touches if touch.obstacle == thing.name}
    return np.array([group in parts for group in groups])
