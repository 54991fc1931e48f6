"""Feedback to a planner that plans again after its contract failed or an operator took over.

The feedback is not part of the fixed template: it is only in requests with a `failure_feedback`, and has its own
version and hash (`full_prompt.conditional_text_hash`). All external text (names, reasons) is in a block that the
rules declare as data.
"""

from __future__ import annotations

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.prompt.sanitize import compact_json
from dualbrain.records import FailureFeedback

FAILURE_FEEDBACK_VERSION = 2
FEEDBACK_INTRO = """\
An earlier contract for this instruction was carried out in part. The scene below is what it left. Answer with the \
actions that are still to do, and change what did not work (another approach, finger_axis, route, clearance, or wait \
until_clear). What is held is held already:"""
MAX_FEEDBACK_CHARACTERS = 900
"""Largest length of the feedback in JSON."""


MAX_REJECTION_CHARACTERS = 1200
"""Largest length of a rejection in JSON."""


def format_failure_feedback(feedback: FailureFeedback) -> str:
    """The executed actions, the failed action, the reason, and the obstacle in the way, after the rules for them."""
    return f"{FEEDBACK_INTRO}\n{_failure_block(feedback)}"


def format_rejection(rejected: Rejected) -> str:
    """The gate's rejection of the last contract, after the request to correct it."""
    return f"Your last contract was refused. Mend what the refusal names:\n{_rejection_block(rejected)}"


def format_failures(rejected: Rejected | None, feedback: FailureFeedback | None) -> list[str]:
    """The blocks for the short prompt: the facts without rules, those of the earlier contract first."""
    blocks = [_failure_block(feedback)] if feedback is not None else []
    return [*blocks, _rejection_block(rejected)] if rejected is not None else blocks


def _failure_block(feedback: FailureFeedback) -> str:
    facts = {
        "done": list(feedback.done),
        "not_done": feedback.failed_action,
        "outcome": feedback.outcome.replace("_", " "),
        "held": feedback.held,
        "reason": feedback.reason,
        "in_the_way": feedback.active_constraints,
    }
    known = {name: value for name, value in facts.items() if value}
    text = compact_json(known, limit=MAX_FEEDBACK_CHARACTERS) or compact_json(
        {"outcome": facts["outcome"], "held": feedback.held}, limit=MAX_FEEDBACK_CHARACTERS
    )
    return f"<refusal>\n{text}\n</refusal>"


def _rejection_block(rejected: Rejected) -> str:
    facts = {
        "stage": rejected.stage,
        "at": rejected.pointer,
        "got": rejected.got,
        "allowed": rejected.allowed,
        "hint": rejected.hint,
    }
    text = compact_json(facts, limit=MAX_REJECTION_CHARACTERS) or compact_json(
        {"stage": rejected.stage}, limit=MAX_REJECTION_CHARACTERS
    )
    return f"<refusal>\n{text}\n</refusal>"
