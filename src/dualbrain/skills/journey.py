"""Journeys: passing through points, insisting after a person has passed, other ways when the first is blocked."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.skills.limb import BESIDE, CEILING, PERSON_PATIENCE, YIELDED, Goal, Limb, Part, lifted
from dualbrain.skills.parameters import CONTACT_SPEED
from dualbrain.skills.person import may_be_over
from dualbrain.skills.progress import STANDSTILL
from dualbrain.skills.route import bend
from dualbrain.skills.skill import Ending, Status

Array = NDArray[np.float64]

RETRY_AFTER = 1.0
"""No progress for this long [s] makes a journey try another way, while one is left."""
GENTLE = 0.9 * CONTACT_SPEED
"""Speed of the last stretch before a contact [m/s]."""
RISE = 0.18
"""How far a blocked tool rises to cross above [m]."""


def arrive(
    limb: Limb, goal: Goal, phase: str, speed: float, *, stop: bool = True, patience: float = STANDSTILL
) -> Part:
    """Reach `goal`, again after each person who came by."""
    while True:
        why = yield from limb.reach(goal, phase, speed, stop=stop, patience=patience)
        if why is not YIELDED:
            return why


def travel(limb: Limb, points: Sequence[Goal], phase: str, speed: float) -> Part:
    """Pass through `points` to the last; when blocked, try over the top, then close by the base."""
    start, end = limb.senses.tool.position.copy(), points[-1]
    ways: list[Callable[[], list[Goal]]] = [
        lambda: list(points),
        lambda: _over_the_top(limb, end),
        lambda: _by_the_base(limb, start, end),
    ]
    why: Ending | None = None
    for index, way in enumerate(ways):
        patience = STANDSTILL if index == len(ways) - 1 else RETRY_AFTER
        why = yield from _pass_through(limb, way(), phase, speed, patience)
        if why is None or why.status is not Status.TAKEN_OVER:
            break
    return why


def come_down(
    limb: Limb, above: Goal, brink: Goal, down: Goal, phase: str, speed: float, *, approach: str
) -> Part:  # fmt: skip
    """Go down from `above` when no person will be there: fast to the `brink`, then gently to `down`.

    Gently means slower than the permitted contact speed, so that no contact row bends the path. After a person came by,
    it starts again from above.
    """
    horizon = 2.0 + 2.0 * float(above.position[2] - down.position[2]) / speed
    while True:
        if why := (yield from wait_for_people(limb, above, down.position, horizon, approach, speed)):
            return why
        why = yield from limb.reach(brink, phase, speed)
        if why is None:
            why = yield from limb.reach(down, phase, GENTLE)
        if why is not YIELDED:
            return why


def wait_for_people(
    limb: Limb, station: Goal, spot: Array, horizon: float, phase: str, speed: float, *, reach: float = BESIDE
) -> Part:  # fmt: skip
    """Stay at `station` until no person's sweep over `horizon` [s] comes within `reach` [m] of `spot`, from above."""
    start = limb.senses.now
    while True:
        if why := (yield from arrive(limb, station, phase, min(speed, 0.2))):
            return why
        if not may_be_over(limb.senses.scene, spot, horizon, reach, limb.senses.now):
            return None
        while may_be_over(limb.senses.scene, spot, horizon, reach, limb.senses.now):
            if limb.senses.now - start > PERSON_PATIENCE:
                return Ending(Status.FAILED, f"{phase}: a person stayed over the place for {PERSON_PATIENCE:.0f} s")
            yield from limb.stay("wait", 0.033)


def _pass_through(limb: Limb, points: Sequence[Goal], phase: str, speed: float, patience: float) -> Part:
    for index, point in enumerate(points):
        last = index == len(points) - 1
        if why := (yield from arrive(limb, point, phase, speed, stop=last, patience=patience)):
            return why
    return None


def _over_the_top(limb: Limb, end: Goal) -> list[Goal]:
    """Straight up by 18 cm, across, down to the end."""
    here = limb.here()
    height = min(max(float(here.position[2]) + RISE, float(end.position[2])), CEILING)
    return [lifted(here, height), lifted(end, height), end]


def _by_the_base(limb: Limb, start: Array, end: Goal) -> list[Goal]:
    """Back to where the journey began to bend, round by the base, at the height of the end."""
    via = bend(start, end.position, "near_base")
    return [end] if via is None else [limb.shifted(end, via), end]
