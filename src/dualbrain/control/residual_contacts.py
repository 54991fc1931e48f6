"""What a hand still touches when its skill was stopped: contacts that outlive the contract they were permitted for.

A skill that ends by itself leaves its contacts; one that is stopped leaves the hand where it is: around a thing, on it,
the load on its support. The permits of its last phase then stay, for those pairs that are still near, until each is
clear; the next contract has them beside its own. Nothing is added that no skill's specification has permitted.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dualbrain.core.geometry.distance import bounding_solid, signed_distance
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import RobotState
from dualbrain.skills.skill import MotionModel, PermittedContact

CLEARANCE = 0.010
"""A part is clear of a thing when this much is between them beyond the error of its position [m]."""
CLOSING_PHASE = "close"
"""The phase in which the fingers close on a target."""
HELD_GROUP = "held"


class ResidualContacts:
    """The contacts that were left over. State: `touches`, and what the fingers were `closing_on`."""

    def __init__(self, motion: MotionModel) -> None:
        """Nothing is touched."""
        self._motion = motion
        self.touches: tuple[PermittedContact, ...] = ()
        self.closing_target = ""

    @property
    def object_names(self) -> frozenset[str]:
        """The things that the hand is still at."""
        return frozenset(touch.obstacle for touch in self.touches)

    @property
    def object_in_fingers(self) -> str | None:
        """The thing that the fingers are still at."""
        return next((touch.obstacle for touch in self.touches if touch.robot_part == "fingers"), None)

    def retain(self, phase: str, touches: Iterable[PermittedContact], state: RobotState, scene: Scene) -> None:
        """A skill is over that stood in `phase`, whose contacts were `touches`: those that are not clear stay."""
        self.touches = tuple(touches)
        self.closing_target = (self.object_in_fingers or "") if phase == CLOSING_PHASE else ""
        self.update(state, scene)

    def update(self, state: RobotState, scene: Scene) -> bool:
        """Let go of what is clear; True if there is less of it now. What is not perceived is not known to be clear."""
        if not self.touches:
            return False
        centres, radii, groups = self._motion.spheres(state.q, state.opening)
        seen = {thing.name: thing for thing in scene.objects}

        def near(touch: PermittedContact) -> bool:
            part = np.array([group == touch.robot_part for group in groups])
            thing = seen.get(touch.obstacle)
            if thing is None or (touch.robot_part == HELD_GROUP and not part.any()):
                return True
            return _min_clearance(thing, centres[part], radii[part]) < CLEARANCE

        left = tuple(touch for touch in self.touches if near(touch))
        if all(touch.robot_part == HELD_GROUP for touch in left) and HELD_GROUP not in groups:
            left = ()
        fewer, self.touches = len(left) < len(self.touches), left
        if self.closing_target not in self.object_names:
            self.closing_target = ""
        return fewer

    def combine(self, touches: tuple[PermittedContact, ...]) -> tuple[PermittedContact, ...]:
        """`touches`, and what is left over of other pairs."""
        pairs = {(touch.robot_part, touch.obstacle) for touch in touches}
        return (*touches, *(touch for touch in self.touches if (touch.robot_part, touch.obstacle) not in pairs))


def _min_clearance(thing: SceneObject, centres: np.ndarray, radii: np.ndarray) -> float:
    """Least distance [m] of spheres from `thing`, beyond its error."""
    apart = signed_distance(*bounding_solid(thing.shape, thing.pose), centres) - radii
    return float(apart.min(initial=np.inf)) - thing.error
