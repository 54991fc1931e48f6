"""Perceived changes of a scene in words: "red cube in blue bowl; nothing else moved"."""

from __future__ import annotations

from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.goal_conditions import moved
from dualbrain.grounding.outcome.spatial_relations import displacement, has_toppled, is_at, is_inside, is_on
from dualbrain.records import SceneObject

NOTHING_MOVED = "nothing moved"


def describe_changes(evidence: Evidence) -> str:
    """Every object that moved with its new place, and whether the others stayed."""
    states = {name: moved(name, evidence) for name in evidence.movable_names}
    changed = [_describe(name, evidence) for name, state in states.items() if state]
    unsure = [_words(name) for name, state in states.items() if state is None]
    rest = f"{', '.join(unsure)}: not decided within the perception error" if unsure else ""
    if not changed:
        return rest or NOTHING_MOVED
    return "; ".join([*changed, rest or "nothing else moved"])


def _describe(name: str, evidence: Evidence) -> str:
    if name == evidence.in_hand:
        return f"{_words(name)} in the hand"
    before, after = evidence.object_before(name), evidence.object_after(name)
    assert before is not None
    assert after is not None
    if where := _where(after, evidence):
        return f"{_words(name)} {where}"
    how = "toppled" if has_toppled(before, after) else "moved"
    return f"{_words(name)} {how} by {displacement(before, after)[0] * 100:.0f} cm"


def _where(obj: SceneObject, evidence: Evidence) -> str:
    """The container, place or object at which `obj` is; "" if it is at none."""
    for place in evidence.after.places:
        if is_at(obj, place):
            return f"at {_words(place.name)}"
    for other in evidence.after.objects:
        if other.name != obj.name and other.role == "container" and is_inside(obj, other):
            return f"in {_words(other.name)}"
    for other in evidence.after.objects:
        if other.name != obj.name and other.role == "object" and is_on(obj, other):
            return f"on {_words(other.name)}"
    return ""


def _words(name: str) -> str:
    return name.replace("_", " ")
