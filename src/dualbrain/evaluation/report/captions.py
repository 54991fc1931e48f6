"""What became of an episode in words for people: kinds of violations, headlines and captions of pictures."""

from __future__ import annotations

from dualbrain.evaluation.analysis.failure_taxonomy import failure_class_of
from dualbrain.evaluation.analysis.severity import safety_kinds, severity
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import Violation

VIOLATION_LABELS = {
    "collision_env": "collision with the environment",
    "collision_human": "collision with a person",
    "collision_held": "collision of the held thing",
    "self_collision": "collision of the robot with itself",
    "joint_limit": "joint position limit",
    "joint_velocity": "joint velocity limit",
    "tcp_speed": "tool speed",
    "force_fragile": "force on a fragile thing",
    "object_dropped": "thing dropped",
    "bystander": "other thing moved",
    "bystander_tilt": "other thing tilted",
    "tilted_load": "load tilted",
    "shaken_load": "load shaken",
    "unauthorised": "unauthorised skill",
}
"""By kind, as `docs/tasks.md` defines them."""
OUTCOME_LABELS = {
    "failed": "the robot gave up",
    "taken_over": "the local layer ended it",
    "stopped": "a check stopped the robot",
    "emergency": "an emergency stop ended it",
    "aborted": "it was broken off",
}
MAX_REASON_CHARACTERS = 110
"""Characters of a reason in a caption."""


def headline(row: EpisodeRow) -> str:
    """The class of the failure, or the kinds of violations of a success, the worst first.

    *Unsafe* is what the metric `succeeded but unsafe` counts.
    """
    ranked = sorted(row.violations, key=lambda one: -severity([one]))
    kinds = ", ".join(dict.fromkeys(VIOLATION_LABELS.get(one.kind, one.kind) for one in ranked))
    how = "succeeded but unsafe" if safety_kinds(row.violations) else "succeeded, with a violation"
    return failure_class_of(row) or f"{how}: {kinds}"


def caption(row: EpisodeRow, violation: Violation | None) -> str:
    """What a picture shows: the violation that was `seen` as it began, or else how the episode ended; and where."""
    said = _describe_end(row)
    if violation is not None:
        kind = VIOLATION_LABELS.get(violation.kind, violation.kind)
        said = f"{kind[0].upper()}{kind[1:]}, {' × '.join(violation.bodies)}, at {violation.start:.1f} s"
    return f"{truncate(said)} ({row.task}, seed {row.seed})"


def truncate(text: str, max_characters: int = MAX_REASON_CHARACTERS) -> str:
    """`text`, ended behind a word with … where it is longer than `most` characters."""
    if len(text) <= max_characters:
        return text
    return text[: max_characters + 1].rpartition(" ")[0].rstrip(" ,;:") + " …"


def _describe_end(row: EpisodeRow) -> str:
    """A sentence about the end, in which the robot's own reason is quoted."""
    if not row.claimed:
        how = OUTCOME_LABELS.get(row.outcome, f"it was {row.outcome.replace('_', ' ')}")
        return f"{how[0].upper()}{how[1:]}: {row.reason}"
    if not row.meant:
        return f"The contract was carried out, “{row.reason}”, and is about something else than what was asked"
    if not row.success:
        return f"The robot holds it to be done, “{row.reason}”; on truth it is not"
    return f"Done: {row.reason}"
