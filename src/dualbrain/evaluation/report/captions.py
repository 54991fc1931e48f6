"""Labels of violations, headlines and captions that describe an episode to people."""

from __future__ import annotations

from dualbrain.evaluation.analysis.failure_taxonomy import failure_class_of
from dualbrain.evaluation.analysis.severity import severity
from dualbrain.evaluation.analysis.violation_kinds import is_unsafe
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import Violation

VIOLATION_LABELS = {
    "collision_env": "collision with the environment",
    "collision_human": "collision with a person",
    "collision_held": "collision of the held object",
    "self_collision": "collision of the robot with itself",
    "joint_limit": "joint position limit",
    "joint_velocity": "joint velocity limit",
    "tcp_speed": "tool speed",
    "force_fragile": "force on a fragile object",
    "object_dropped": "object dropped",
    "bystander": "other object moved",
    "bystander_tilt": "other object tilted",
    "tilted_load": "load tilted",
    "shaken_load": "load shaken",
    "unauthorised": "unauthorised skill",
}
"""Label by kind; `docs/explanation/tasks.md` defines the kinds."""
OUTCOME_LABELS = {
    "failed": "the robot gave up",
    "taken_over": "the safety layer ended the contract",
    "stopped": "a check stopped the robot",
    "emergency": "an emergency stop ended the contract",
    "aborted": "the contract was aborted",
}
MAX_REASON_CHARACTERS = 110
"""Maximum length of the description in a caption."""


def headline(row: EpisodeRow) -> str:
    """Class of the failure, or of a success the kinds of its violations, the most severe first.

    "Unsafe" has the meaning of the metric `succeeded but unsafe`.
    """
    ranked = sorted(row.violations, key=lambda one: -severity([one]))
    kinds = ", ".join(dict.fromkeys(VIOLATION_LABELS.get(one.kind, one.kind) for one in ranked))
    how = "succeeded but unsafe" if is_unsafe(row.violations) else "succeeded, with a violation"
    return failure_class_of(row) or f"{how}: {kinds}"


def caption(row: EpisodeRow, violation: Violation | None) -> str:
    """Caption of an image: the `violation` that it shows, or else the end of the episode, with task and seed."""
    text = _describe_end(row)
    if violation is not None:
        kind = VIOLATION_LABELS.get(violation.kind, violation.kind)
        text = f"{kind[0].upper()}{kind[1:]}, {' × '.join(violation.bodies)}, at {violation.start:.1f} s"
    return f"{truncate(text)} ({row.task}, seed {row.seed})"


def truncate(text: str, max_characters: int = MAX_REASON_CHARACTERS) -> str:
    """`text`, cut at a word and ended with … if it is longer than `max_characters`."""
    if len(text) <= max_characters:
        return text
    return text[: max_characters + 1].rpartition(" ")[0].rstrip(" ,;:") + " …"


def _describe_end(row: EpisodeRow) -> str:
    """Description of the end of an episode, with the reason that the robot gave."""
    if not row.claimed:
        how = OUTCOME_LABELS.get(row.outcome, f"the contract was {row.outcome.replace('_', ' ')}")
        return f"{how[0].upper()}{how[1:]}: {row.reason}"
    if not row.meant:
        return f"The robot executed the contract, “{row.reason}”, but the contract is not about the instruction"
    if not row.success:
        return f"The robot reports success, “{row.reason}”; the ground truth disagrees"
    return f"Done: {row.reason}"
