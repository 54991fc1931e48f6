"""Sense "still held": finger forces and opening after the motion, for an object that the contract leaves in hand."""

from __future__ import annotations

from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.records import SenseVerdict

NAME = "held"


def judge_held(evidence: Evidence) -> SenseVerdict:
    """Whether the last grip still holds, if the contract does not end it."""
    grip = evidence.grips[-1] if evidence.grips else None
    if grip is None:
        return SenseVerdict(NAME, "not judged", "Nothing was gripped.")
    if grip.released:
        return SenseVerdict(NAME, "not judged", f"The contract released {grip.object_name}.")
    gap = f"{2000.0 * grip.end_opening:.0f} mm between the fingers, {grip.end_force:.1f} N"
    if grip.holds_at_end:
        return SenseVerdict(NAME, "confirmed", f"{grip.object_name} is in the hand: {gap}.")
    return SenseVerdict(NAME, "contradicted", f"{grip.object_name} was lost from the hand: {gap}.")
