"""Sense "placed at the destination": the perceived pose, height included, against the destination of the contract."""

from __future__ import annotations

from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.spatial_relations import is_at, is_inside
from dualbrain.records import SenseVerdict

NAME = "placed"


def judge_placed(evidence: Evidence) -> SenseVerdict:
    """Whether every object that the contract places is at its last destination."""
    if not evidence.placements:
        return SenseVerdict(NAME, "not judged", "The contract places nothing.")
    found = {name: _is_at(name, where, evidence) for name, where in evidence.placements.items()}
    if missed := [name for name, state in found.items() if state is False]:
        text = ", ".join(f"{name} is not at {evidence.placements[name]}" for name in missed)
        return SenseVerdict(NAME, "contradicted", f"Perceived: {text}.")
    if unsure := [name for name, state in found.items() if state is None]:
        text = ", ".join(unsure)
        return SenseVerdict(NAME, "not judged", f"Perception does not decide where {text} is.")
    text = ", ".join(f"{name} at {where}" for name, where in evidence.placements.items())
    return SenseVerdict(NAME, "confirmed", f"Perceived: {text}.")


def _is_at(name: str, destination: str, evidence: Evidence) -> bool | None:
    obj = evidence.object_after(name)
    if obj is None:
        return None
    if name == evidence.in_hand:
        return False
    place = next((one for one in evidence.after.places if one.name == destination), None)
    if place is not None:
        return is_at(obj, place)
    target = evidence.object_after(destination)
    return None if target is None else is_inside(obj, target)
