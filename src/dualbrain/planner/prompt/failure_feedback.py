"""What a planner is told when it plans again, after a contract that failed or was taken over.

It stands beside the unchanging template, in questions that have a setback only, and has a version and hash of its own.
Everything that comes from outside (names, reasons) stands inside the block that the rules declare to be data.
"""

from __future__ import annotations

from dualbrain.planner.prompt.sanitize import compact_json
from dualbrain.records import FailureFeedback

FAILURE_FEEDBACK_VERSION = 1
FEEDBACK_INTRO = """\
An earlier contract for this instruction was carried out in part. The scene below is what it left. Answer with the \
actions that are still to do, and change what did not work (another approach, finger_axis, route, clearance, or wait \
until_clear). What is held is held already:"""
MAX_FEEDBACK_CHARACTERS = 900
"""Characters of what is told."""


def format_failure_feedback(setback: FailureFeedback) -> str:
    """Which actions were done, which one was not, why, and what stood in the way."""
    facts = {
        "done": list(setback.done),
        "not_done": setback.undone,
        "outcome": setback.outcome.replace("_", " "),
        "reason": setback.reason,
        "in_the_way": setback.hindrance,
    }
    told = {name: value for name, value in facts.items() if value}
    text = compact_json(told, limit=MAX_FEEDBACK_CHARACTERS) or compact_json(
        {"outcome": facts["outcome"]}, limit=MAX_FEEDBACK_CHARACTERS
    )
    return f"{FEEDBACK_INTRO}\n<refusal>\n{text}\n</refusal>"
