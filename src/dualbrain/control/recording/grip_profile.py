"""Profiles of grips: forces and openings of the fingers from the trace of a contract.

A grip lasts from the beginning of a `grasp` to the end of the next action that opens the hand, or to the end of the
trace. The grip of an object that is in the hand when the contract begins lasts from the first tick. The profile depends
only on measurements and on the order of actions, not on the phases inside a skill. Ticks in which a force or the
opening is not finite, because a sensor fails, do not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action, Contract
from dualbrain.control.recording.trace import Array, Trace
from dualbrain.records import CLOSING_WINDOW, GripProfile
from dualbrain.skills.arm.load_monitor import EMPTY_OPENING

CONTACT_FORCE = 0.5
"""Force on each finger that counts as contact [N]."""
SETTLING_TIME = 0.15
"""Time [s] after the first contact in which the fingers still close onto the surface."""
OPENING_SKILLS = ("place", "release")
"""Skills that open the hand."""
BEFORE_THE_CONTRACT = -1
"""Index of the grasp of an object that is in the hand when the contract begins."""


def grip_profiles(trace: Trace, first: int, contract: Contract, held: str | None = None) -> tuple[GripProfile, ...]:
    """One profile for each grasp of `contract` whose fingers pressed; the contract began at tick `first` of `trace`.

    The object `held`, in the hand when the contract began, has the first profile.
    """
    if len(trace) <= first:
        return ()
    actions = contract.action_sequence
    ticks = trace["action"][first:]
    profiles = [_profile(trace, first, ticks, actions, *grasp) for grasp in _grasps(actions, held)]
    return tuple(one for one in profiles if one is not None)


def _grasps(actions: Sequence[Action], held: str | None) -> list[tuple[int, str]]:
    """Index of the action and name of the object of each grasp."""
    earlier = [(BEFORE_THE_CONTRACT, held)] if held else []
    grasps = [(index, str(one.params["object"])) for index, one in enumerate(actions) if one.skill == "grasp"]
    return [*earlier, *grasps]


def _profile(
    trace: Trace, first: int, ticks: Array, actions: Sequence[Action], index: int, name: str
) -> GripProfile | None:
    begun = np.zeros(1, np.intp) if index == BEFORE_THE_CONTRACT else np.flatnonzero(ticks == index)
    if not len(begun):
        return None
    ending = next((later for later in range(index + 1, len(actions)) if _ends_grip(actions[later])), None)
    ended = np.flatnonzero(ticks == ending) if ending is not None else np.zeros(0, np.intp)
    span = slice(first + int(begun[0]), first + int(ended[-1]) + 1 if len(ended) else len(trace))
    forces, opening, t = trace["forces"][span], trace["opening"][span], trace["t"][span]
    measured = np.isfinite(forces).all(axis=1) & np.isfinite(opening)
    forces, opening, t = forces[measured], opening[measured], t[measured]
    pressing = np.min(forces, axis=1) >= CONTACT_FORCE
    if not pressing.any():
        return None
    contact = int(np.argmax(pressing))
    end_force, end_opening = float(np.min(trace["forces"][-1])), float(trace["opening"][-1])
    if not np.isfinite((end_force, end_opening)).all():
        end_force, end_opening = 0.0, float(opening[-1])  # without a measurement nothing counts as held
    released = bool(len(ended)) and actions[ending or 0].skill in OPENING_SKILLS and not pressing[-1]
    return GripProfile(
        object_name=name,
        max_force=float(np.max(forces)),
        first_opening=float(opening[contact]),
        min_opening=float(np.min(opening[pressing])),
        fastest_closing=_fastest_closing(t, opening, pressing, contact),
        released=released,
        end_force=end_force,
        end_opening=end_opening,
        holds_at_end=not released and end_force >= CONTACT_FORCE and end_opening >= EMPTY_OPENING,
    )


def _ends_grip(action: Action) -> bool:
    return action.skill in (*OPENING_SKILLS, "grasp")


def _fastest_closing(t: Array, opening: Array, pressing: NDArray[np.bool_], contact: int) -> float:
    """Largest decrease of the opening within `CLOSING_WINDOW`, from settled contact on, both ends under load."""
    steps = np.diff(t[np.isfinite(t)])  # of a clock that may have failed
    forward = steps[steps > 0.0]
    period = max(float(np.median(forward)), 1e-6) if len(forward) else CLOSING_WINDOW
    step, start = max(1, round(CLOSING_WINDOW / period)), contact + round(SETTLING_TIME / period)
    if len(opening) - start <= step:
        return 0.0
    gap, loaded = opening[start:], pressing[start:]
    closing = gap[:-step] - gap[step:]
    valid = loaded[:-step] & loaded[step:]
    return max(0.0, float(np.max(closing[valid], initial=0.0)))
