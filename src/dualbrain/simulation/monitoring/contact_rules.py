"""Permitted contacts for each phase of a skill: a table over pairs of geoms, rebuilt when the phase changes.

Verdict of a pair: 0 ignored, 1 robot against the environment, 2 robot or held object against a person, 3 robot against
itself, 4 held object against the environment or against the arm that holds it.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.scene_builder import ROBOT_PREFIX
from dualbrain.simulation.scenes.scene_spec import SceneSpec

IGNORED, ENVIRONMENT_CONTACT, HUMAN_CONTACT, SELF_CONTACT, HELD_CONTACT = 0, 1, 2, 3, 4

CONTACT_PHASES: dict[str, str] = {
    "free": "nothing may touch",
    "grasp": "fingers may touch the target",
    "lift": "fingers may touch the held object, which may still touch the table",
    "carry": "fingers may touch the held object",
    "lower": "fingers may touch the held object, which may touch the destination and the table",
    "release": "as lower, and the fingers may touch the target",
    "retreat": "fingers may still touch the target",
    "push": "fingers and hand may touch the target",
}
TABLE_CONTACT_PHASES = ("lift", "lower", "release")


@dataclass(frozen=True, slots=True)
class ContactAllowance:
    """The permitted contacts of the running skill: its target, the held object, the destination and the phase."""

    target: str | None = None
    held: str | None = None
    destination: str | None = None
    phase: str = "free"


class ContactRules:
    """The owner of every geom, and the verdict for a pair of geoms under a `ContactAllowance`."""

    def __init__(self, model: mujoco.MjModel, spec: SceneSpec) -> None:
        """Index the geoms of `model` by owner: robot link, object, person, room."""
        self._spec = spec
        bodies = [model.body(int(body)).name for body in model.geom_bodyid]
        self.owners = [model.geom(geom).name if body == "world" else body for geom, body in enumerate(bodies)]
        self.robot_mask = np.array([owner.startswith(ROBOT_PREFIX) for owner in self.owners])
        fingers = (f"{ROBOT_PREFIX}left_finger", f"{ROBOT_PREFIX}right_finger")
        self.finger_mask = np.array([owner in fingers for owner in self.owners])
        self.hand_mask = self.finger_mask | np.array([owner == f"{ROBOT_PREFIX}hand" for owner in self.owners])
        self.person_mask = self._mask(spec.mover.name if spec.mover is not None else None)
        self.fragile_limits = np.full(model.ngeom, np.inf)
        for obj in spec.objects:
            if obj.fragile_limit is not None:
                self.fragile_limits[self._mask(obj.name)] = obj.fragile_limit

    def verdict_table(self, allowance: ContactAllowance) -> NDArray[np.uint8]:
        """Verdict for each pair of geoms, shape (ngeom, ngeom), symmetric.

        Raises `UnknownNameError` for an unknown phase or object.
        """
        self._check(allowance)
        robot, person = self.robot_mask, self.person_mask
        target, held = self._mask(allowance.target), self._mask(allowance.held)
        ours = robot | held
        verdict = np.zeros((len(robot), len(robot)), np.uint8)
        _set_pairs(verdict, robot, ~ours & ~person, ENVIRONMENT_CONTACT)
        _set_pairs(verdict, held, ~ours & ~person, HELD_CONTACT)
        _set_pairs(verdict, ours, person, HUMAN_CONTACT)
        _set_pairs(verdict, robot, robot, SELF_CONTACT)
        _set_pairs(verdict, self.finger_mask, self.finger_mask, IGNORED)
        _set_pairs(verdict, robot & ~self.finger_mask, held, HELD_CONTACT)
        _set_pairs(verdict, self.finger_mask, held, IGNORED)
        if allowance.phase in ("grasp", "release", "retreat"):
            _set_pairs(verdict, self.finger_mask, target, IGNORED)
        if allowance.phase == "push":
            _set_pairs(verdict, self.hand_mask, target, IGNORED)
        if allowance.phase in TABLE_CONTACT_PHASES:
            _set_pairs(verdict, held, self._mask("table"), IGNORED)
        if allowance.phase in ("lower", "release"):
            _set_pairs(verdict, held, self._mask(allowance.destination), IGNORED)
        return verdict

    def _mask(self, name: str | None) -> NDArray[np.bool_]:
        return np.array([name is not None and owner == name for owner in self.owners])

    def _check(self, allowance: ContactAllowance) -> None:
        if allowance.phase not in CONTACT_PHASES:
            raise UnknownNameError("contact phase", allowance.phase, tuple(CONTACT_PHASES))
        known = tuple(obj.name for obj in self._spec.objects)
        places = tuple(place.name for place in self._spec.places)
        for name, names in (
            (allowance.target, known),
            (allowance.held, known),
            (allowance.destination, (*known, *places, "table")),
        ):
            if name is not None and name not in names:
                raise UnknownNameError("object", name, names, owner="the scene")


def _set_pairs(verdict: NDArray[np.uint8], first: NDArray[np.bool_], second: NDArray[np.bool_], value: int) -> None:
    """Set `value` for every pair of a geom of `first` and a geom of `second`, in both orders."""
    verdict[np.ix_(first, second)] = value
    verdict[np.ix_(second, first)] = value
