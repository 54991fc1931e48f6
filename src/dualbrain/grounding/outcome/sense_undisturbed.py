"""Sense "nothing else moved": perceived displacement of every object that the contract does not handle."""

from __future__ import annotations

from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.goal_conditions import moved
from dualbrain.records import SenseVerdict

NAME = "undisturbed"


def judge_undisturbed(evidence: Evidence, handled: frozenset[str]) -> SenseVerdict:
    """Whether every object except those in `handled` stayed where it was, beyond the perception error."""
    states = {name: moved(name, evidence) for name in evidence.movable_names if name not in handled}
    if not states:
        return SenseVerdict(NAME, "not judged", "There is no other object.")
    if shifted := [name for name, state in states.items() if state]:
        return SenseVerdict(NAME, "contradicted", f"{', '.join(shifted)} moved.")
    if unsure := [name for name, state in states.items() if state is None]:
        return SenseVerdict(NAME, "not judged", f"Perception does not decide whether {', '.join(unsure)} moved.")
    return SenseVerdict(NAME, "confirmed", "No other object moved.")
