"""Feedback to a planner that plans again after its contract failed or an operator took over.

The feedback is not part of the fixed template: it is only in requests with a `failure_feedback`, and has its own
version and hash (`full_prompt.conditional_text_hash`). All external text (names, reasons) is in a block that the
rules declare as data.
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
"""Largest length of the feedback in JSON."""


def format_failure_feedback(feedback: FailureFeedback) -> str:
    """The executed actions, the failed action, the reason, and the obstacle in the way."""
    facts = {
        "done": list(feedback.done),
        "not_done": feedback.failed_action,
        "outcome": feedback.outcome.replace("_", " "),
        "reason": feedback.reason,
        "in_the_way": feedback.active_constraints,
    }
    known = {name: value for name, value in facts.items() if value}
    text = compact_json(known, limit=MAX_FEEDBACK_CHARACTERS) or compact_json(
        {"outcome": facts["outcome"]}, limit=MAX_FEEDBACK_CHARACTERS
    )
    return f"{FEEDBACK_INTRO}\n<refusal>\n{text}\n</refusal>"
