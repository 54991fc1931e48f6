"""Journeys: passing through points, insisting after a person has passed, other ways when the first is blocked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.skills.arm.controller import BESIDE, CEILING, PERSON_PATIENCE, YIELDED, Goal, Limb, Part, lifted
from dualbrain.skills.human_prediction import may_be_over
from dualbrain.skills.parameters import CONTACT_SPEED
from dualbrain.skills.progress_watchdog import STANDSTILL
from dualbrain.skills.skill import Ending, Status
from dualbrain.skills.time_slicing import AIR, Thought, clearest

Array = NDArray[np.float64]

RETRY_AFTER = 1.0
"""No progress for this long [s] makes a journey try a detour, while one is left."""
DETOURS = (
    (0.18, "direct"), (0.0, "near_base"), (0.05, "direct"), (0.1, "direct"), (0.0, "left"), (0.0, "right"),
    (0.05, "near_base"), (0.1, "near_base"), (0.05, "left"), (0.05, "right"), (0.1, "left"), (0.1, "right"),
)  # fmt: skip
"""How far a blocked tool rises [m], and by which route it crosses then; the most telling first."""
GENTLE = 0.9 * CONTACT_SPEED
"""Speed of the last stretch before a contact [m/s]."""


def arrive(
    limb: Limb, goal: Goal, phase: str, speed: float, *, stop: bool = True, patience: float = STANDSTILL
) -> Part:
    """Reach `goal`, again after each person who came by."""
    while True:
        why = yield from limb.reach(goal, phase, speed, stop=stop, patience=patience)
        if why is not YIELDED:
            return why


def climb(limb: Limb, height: float, phase: str, speed: float) -> Part:
    """Straight up (or down) to tool height `height` [m]."""
    up = lifted(limb.here(), height)
    goal = yield from limb.shifted(up, up.position)
    return (yield from arrive(limb, goal, phase, speed))


def travel(limb: Limb, points: Sequence[Goal], phase: str, speed: float) -> Part:
    """Pass through `points` to the last; when blocked, by the first detour that looks clear, else the roomiest."""
    start, end, left = limb.senses.tool.position.copy(), points[-1], list(DETOURS)
    why = yield from _pass_through(limb, points, phase, speed, RETRY_AFTER)
    for patience in (RETRY_AFTER, STANDSTILL):
        if why is None or why.status is not Status.TAKEN_OVER:
            break
        detour, _ = yield from clearest(left, lambda detour, beat: _air_by(limb, start, end, detour, phase, beat))
        detour = detour or left[0]
        left.remove(detour)
        way = yield from _by(limb, start, end, detour)
        why = yield from _pass_through(limb, way, phase, speed, patience)
    return why


def foreseen(limb: Limb, points: Sequence[Goal], phase: str, beat: float) -> Thought[float]:
    """Room [m] on the way through `points` to the last, or on the detour `travel` would take; `beat` as in `air`."""
    start, end = limb.senses.tool.position.copy(), points[-1]
    plain = yield from limb.air(None, points, phase, beat=beat)
    if plain >= AIR:
        return plain
    _, most = yield from clearest(
        DETOURS, lambda detour, beat: _air_by(limb, start, end, detour, phase, beat), beat=max(plain, beat)
    )
    return most


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


def _air_by(
    limb: Limb, start: Array, end: Goal, detour: tuple[float, str], phase: str, beat: float
) -> Thought[float]:  # fmt: skip
    way = yield from _by(limb, start, end, detour)
    return (yield from limb.air(None, way, phase, beat=beat))


def _by(limb: Limb, start: Array, end: Goal, detour: tuple[float, str]) -> Thought[list[Goal]]:
    """Straight up by the detour's rise, across by its route, down to the end."""
    rise, route = detour
    here = limb.here()
    height = max(float(end.position[2]), min(max(float(here.position[2]), float(end.position[2])) + rise, CEILING))
    high = lifted(end, height)
    via = bend(start, high.position, route)
    points = [lifted(here, height)] if rise else []
    if via is not None:
        points.append((yield from limb.shifted(end, via)))
    return [*points, high, end] if rise else [*points, end]


Array = NDArray[np.float64]

NEAR_BASE = 0.36
"""Distance from the base at which the route close to the base passes [m]."""
ASIDE = 0.15
"""How far left and right routes bend from the straight line [m]."""
REACH = (0.34, 0.68)
"""A bend stays within this distance from the base [m]."""


def bend(start: Array, end: Array, route: str) -> Array | None:
    """The point (3,) that `route` passes between `start` and `end`, at the height of `end`; None when straight."""
    if route == "direct":
        return None
    middle = (start + end)[:2] / 2
    if route == "near_base":
        via = middle * (NEAR_BASE / (np.linalg.norm(middle) + 1e-9))
    else:
        line = (end - start)[:2]
        left = np.array([-line[1], line[0]]) / (np.linalg.norm(line) + 1e-9)
        via = middle + (ASIDE if route == "left" else -ASIDE) * left
        distance = float(np.linalg.norm(via))
        via = via * (float(np.clip(distance, *REACH)) / (distance + 1e-9))
    return np.array([via[0], via[1], end[2]])
