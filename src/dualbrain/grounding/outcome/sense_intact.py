"""Sense "intact": force profile and finger gap of every grip, and size and posture of the object afterwards."""

from __future__ import annotations

from dualbrain.core.geometry.shapes import Bowl, Cylinder
from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.spatial_relations import has_toppled, vertical_extent
from dualbrain.records import GripProfile, SceneObject, SenseVerdict

NAME = "intact"
CRUSH_CLOSING = 0.003
"""A finger that closes by this much [m] within `records.CLOSING_WINDOW` under load has crushed what it holds."""
SIZE_LOSS = 0.35
"""An object whose perceived height has decreased by more than this share is broken or crushed."""
FORCE_MARGIN = 0.95
"""Share of the fragile limit from which a measured finger force counts as above it: the pads are sampled."""


def judge_intact(evidence: Evidence) -> SenseVerdict:
    """Whether every object that was gripped in any try survived.

    Not judged if nothing was gripped or no finger force was measured.
    """
    grips = evidence.all_grips
    if not grips:
        return SenseVerdict(NAME, "not judged", "Nothing was gripped.")
    for grip in grips:
        if reason := _damage(grip, evidence):
            return SenseVerdict(NAME, "contradicted", reason)
    if unknown := next((reason for grip in grips if (reason := _unknown(grip, evidence))), ""):
        return SenseVerdict(NAME, "not judged", unknown)
    text = "; ".join(f"{grip.object_name}: at most {grip.max_force:.1f} N" for grip in grips)
    return SenseVerdict(NAME, "confirmed", f"{text}; the gap did not collapse.")


def _damage(grip: GripProfile, evidence: Evidence) -> str:
    name, before = grip.object_name, evidence.object_before(grip.object_name)
    after = evidence.object_after(name)
    if before and before.fragile_limit is not None and grip.max_force >= FORCE_MARGIN * before.fragile_limit:
        return f"The fingers pressed {name} with {grip.max_force:.1f} N; it breaks at {before.fragile_limit:.1f} N."
    if grip.fastest_closing >= CRUSH_CLOSING:
        return f"The gap at {name} collapsed by {2000.0 * grip.fastest_closing:.1f} mm under load."
    if before is None:
        return ""
    if after is None:
        return f"{name} is fragile and no longer perceived." if before.fragile_limit is not None else ""
    return _changed(before, after, evidence)


def _changed(before: SceneObject, after: SceneObject, evidence: Evidence) -> str:
    """Loss of height, or a fall outside of a container."""
    if type(before.shape) is type(after.shape):
        heights = [high - low for low, high in (vertical_extent(before), vertical_extent(after))]
        upright = not has_toppled(before, after)
        if upright and heights[1] < (1.0 - SIZE_LOSS) * heights[0] - after.error:
            return f"{before.name} is perceived {heights[1] * 1000:.0f} mm high, {heights[0] * 1000:.0f} mm before."
    contained = any(
        isinstance(obj.shape, Bowl) and obj.name == evidence.placements.get(before.name)
        for obj in evidence.after.objects
    )
    free = not contained and before.name != evidence.in_hand
    if free and isinstance(before.shape, Cylinder) and has_toppled(before, after):
        return f"{before.name} has toppled."
    return ""


def _unknown(grip: GripProfile, evidence: Evidence) -> str:
    if grip.max_force <= 0.0:
        return f"No finger force was measured while {grip.object_name} was gripped."
    if evidence.object_after(grip.object_name) is None:
        return f"{grip.object_name} is no longer perceived."
    return ""
