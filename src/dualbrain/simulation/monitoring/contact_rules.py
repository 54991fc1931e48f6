"""Which contacts are allowed in which phase of a skill: a table over pairs of geoms, rebuilt when the phase changes.

Verdict of a pair: 0 no business of the monitor, 1 robot against the environment, 2 robot or held thing against a
person, 3 robot against itself, 4 held thing against the environment or against the arm that holds it.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UnknownName
from dualbrain.simulation.scenes.scene_builder import PREFIX
from dualbrain.simulation.scenes.scene_spec import SceneSpec

QUIET, ENVIRONMENT, HUMAN, SELF, HELD = 0, 1, 2, 3, 4

PHASES: dict[str, str] = {
    "free": "nothing may touch",
    "grasp": "fingers may touch the target",
    "lift": "fingers may touch the held thing, which may still touch the table",
    "carry": "fingers may touch the held thing",
    "lower": "fingers may touch the held thing, which may touch the destination and the table",
    "release": "as lower, and the fingers may touch the target",
    "retreat": "fingers may still touch the target",
    "push": "fingers and hand may touch the target",
}
SUPPORTED = ("lift", "lower", "release")


@dataclass(frozen=True, slots=True)
class Allowance:
    """What the running skill declares: its target, what it holds, where that goes, and its phase."""

    target: str | None = None
    held: str | None = None
    destination: str | None = None
    phase: str = "free"


class ContactRules:
    """Knows every geom's owner and says how to judge a pair of geoms under an `Allowance`."""

    def __init__(self, model: mujoco.MjModel, spec: SceneSpec) -> None:
        """Index the geoms of `model` by owner: robot link, thing, person, room."""
        self._spec = spec
        bodies = [model.body(int(body)).name for body in model.geom_bodyid]
        self.owner = [model.geom(geom).name if body == "world" else body for geom, body in enumerate(bodies)]
        self.robot = np.array([owner.startswith(PREFIX) for owner in self.owner])
        fingers = (f"{PREFIX}left_finger", f"{PREFIX}right_finger")
        self.fingers = np.array([owner in fingers for owner in self.owner])
        self.hand = self.fingers | np.array([owner == f"{PREFIX}hand" for owner in self.owner])
        self.person = self._mask(spec.mover.name if spec.mover is not None else None)
        self.fragile = np.full(model.ngeom, np.inf)
        for thing in spec.things:
            if thing.fragile_limit is not None:
                self.fragile[self._mask(thing.name)] = thing.fragile_limit

    def table(self, allowance: Allowance) -> NDArray[np.uint8]:
        """Verdict by pair of geoms, shape (ngeom, ngeom), symmetric; raises `UnknownName` for a phase or a thing."""
        self._check(allowance)
        robot, person = self.robot, self.person
        target, held = self._mask(allowance.target), self._mask(allowance.held)
        ours = robot | held
        verdict = np.zeros((len(robot), len(robot)), np.uint8)
        _put(verdict, robot, ~ours & ~person, ENVIRONMENT)
        _put(verdict, held, ~ours & ~person, HELD)
        _put(verdict, ours, person, HUMAN)
        _put(verdict, robot, robot, SELF)
        _put(verdict, self.fingers, self.fingers, QUIET)
        _put(verdict, robot & ~self.fingers, held, HELD)
        _put(verdict, self.fingers, held, QUIET)
        if allowance.phase in ("grasp", "release", "retreat"):
            _put(verdict, self.fingers, target, QUIET)
        if allowance.phase == "push":
            _put(verdict, self.hand, target, QUIET)
        if allowance.phase in SUPPORTED:
            _put(verdict, held, self._mask("table"), QUIET)
        if allowance.phase in ("lower", "release"):
            _put(verdict, held, self._mask(allowance.destination), QUIET)
        return verdict

    def _mask(self, name: str | None) -> NDArray[np.bool_]:
        return np.array([name is not None and owner == name for owner in self.owner])

    def _check(self, allowance: Allowance) -> None:
        if allowance.phase not in PHASES:
            raise UnknownName("contact phase", allowance.phase, tuple(PHASES))
        known = tuple(thing.name for thing in self._spec.things)
        places = tuple(place.name for place in self._spec.places)
        for name, names in (
            (allowance.target, known),
            (allowance.held, known),
            (allowance.destination, (*known, *places, "table")),
        ):
            if name is not None and name not in names:
                raise UnknownName("thing", name, names, owner="the scene")


def _put(verdict: NDArray[np.uint8], first: NDArray[np.bool_], second: NDArray[np.bool_], value: int) -> None:
    """Set `value` for every pair of one from `first` and one from `second`, in both orders."""
    verdict[np.ix_(first, second)] = value
    verdict[np.ix_(second, first)] = value
