"""Contact permits that outlive their contract, because the hand still touches an object when its skill is stopped.

A skill that ends by itself ends its contacts. A skill that is stopped leaves the hand around or on an object, or the
grasped object on its support. The permits of the skill's last phase then remain for every pair that is still near,
until the pair is clear; the next contract has them in addition to its own. No contact is added that no skill's
specification permits.

A permit that ends with a phase ends with hysteresis: it remains for a pair whose margin would be short without it,
until the margin is intact by the newest observation and by the estimate that the filter has in force, both at the age
that they have in its next step. Its contact speed is 0: the pair may not approach, and no retreat from an object at
rest is demanded. The end of a permit therefore does not make a margin short.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from dualbrain.control.robot_cover import RobotCover, RobotSpheres
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacle_from_checked_object
from dualbrain.skills.kinematics.object_geometry import CLEARANCE
from dualbrain.skills.skill import PermittedContact

CLOSING_PHASE = "close"
"""The phase in which the fingers close on a target."""
INTACT_CLEARANCE = 0.001
"""Barrier value h [m] from which a margin is intact; a permit that ended with its phase is then withdrawn."""
HELD_GROUP = "held"
"""Group of the spheres that cover the grasped object."""


class ResidualContacts:
    """The residual contacts of one robot.

    State: `contacts`, the permits that remain (those that ended with a phase until the margin is intact, the others
    until the pair is clear), and `closing_target`, the object on which the fingers were closing, ""
    if there is none.
    """

    def __init__(self, safety: SafetyFilter) -> None:
        """Start without residual contacts; `safety` knows the robot's spheres and the obstacles in force."""
        self._safety, self._spheres = safety, RobotSpheres(safety)
        self.contacts: tuple[PermittedContact, ...] = ()
        self._ending: frozenset[tuple[str, str]] = frozenset()
        self.closing_target = ""

    @property
    def object_names(self) -> frozenset[str]:
        """Names of the objects that the robot still touches."""
        return frozenset(contact.obstacle for contact in self.contacts)

    @property
    def object_in_fingers(self) -> str | None:
        """Name of the object that the fingers still touch, None if there is none."""
        return next((contact.obstacle for contact in self.contacts if contact.robot_part == "fingers"), None)

    def retain(
        self, phase: str, contacts: Iterable[PermittedContact], state: RobotState, scene: Scene, now: float
    ) -> None:
        """Retain those of the `contacts` of a skill that ended in `phase` that are not clear at `now` [s]."""
        self.contacts, self._ending = tuple(contacts), frozenset()
        self.closing_target = (self.object_in_fingers or "") if phase == CLOSING_PHASE else ""
        self.update(state, scene, now)

    def keep_until_intact(
        self, ending: Iterable[PermittedContact], state: RobotState, scene: Scene, now: float, *, held: str | None
    ) -> None:
        """Keep the permits `ending` with a phase, at contact speed 0, for every pair whose margin would be short now.

        Contacts with the object `held` are withdrawn, because it is no obstacle any more.
        """
        known = {_pair(one) for one in self.contacts}
        kept = tuple(replace(one, speed=0.0) for one in ending if _pair(one) not in known and one.obstacle != held)
        self.contacts = (*self.contacts, *kept)
        self._ending |= {_pair(one) for one in kept}
        self.update(state, scene, now)

    def update(self, state: RobotState, scene: Scene, now: float) -> bool:
        """Remove the contacts that are clear at `now` [s]; returns whether any was removed.

        A contact with an object that is not perceived is not known to be clear and remains.
        """
        if not self.contacts:
            return False
        cover = self._spheres.at(state, now - scene.stamp)
        perceived = {obj.name: obj for obj in scene.objects}
        held = any(HELD_GROUP in parts for parts in cover.parts)

        def near(contact: PermittedContact) -> bool:
            obj = perceived.get(contact.obstacle)
            if obj is None or (contact.robot_part == HELD_GROUP and not held):
                return True
            enough = INTACT_CLEARANCE if _pair(contact) in self._ending else CLEARANCE
            return self._clearance(contact.robot_part, obj, scene.stamp, now, cover) < enough

        remaining = tuple(contact for contact in self.contacts if near(contact))
        if all(contact.robot_part == HELD_GROUP for contact in remaining) and not held:
            remaining = ()
        removed, self.contacts = len(remaining) < len(self.contacts), remaining
        self._ending &= {_pair(one) for one in remaining}
        if self.closing_target not in self.object_names:
            self.closing_target = ""
        return removed

    def _clearance(self, part: str, obj: SceneObject, stamp: float, now: float, cover: RobotCover) -> float:
        """Least h [m] of `part` and `obj` at `now` [s], as observed at `stamp` [s] and as the filter has it."""
        tables = self._safety.tables
        observed = cover.part_clearance(part, obstacle_from_checked_object(obj, stamp, known=True))
        later = replace(cover, age=max(0.0, now - tables.stamp))
        in_force = (later.part_clearance(part, one) for one in tables.obstacles if one.name == obj.name)
        return min((observed, *in_force))

    def combine(self, contacts: tuple[PermittedContact, ...]) -> tuple[PermittedContact, ...]:
        """`contacts`, and the residual contacts of all other pairs of a robot part and an object."""
        pairs = {_pair(contact) for contact in contacts}
        return (*contacts, *(one for one in self.contacts if _pair(one) not in pairs))


def _pair(contact: PermittedContact) -> tuple[str, str]:
    return contact.robot_part, contact.obstacle
