"""Words for the verdict on one shot, for the log and for the reason of an outcome."""

from __future__ import annotations

from dualbrain.contracts.contract import action_in_words
from dualbrain.contracts.verdict import STAGES, Accepted, Rejected, Verdict
from dualbrain.planner.protocol import describe_failure, has_answer
from dualbrain.records import Attempt


def format_attempt(shot: int, attempt: Attempt) -> str:
    """The verdict on the shot with the number `shot`, or the reason for which the planner gave no answer."""
    if has_answer(attempt.proposal):
        return format_verdict(shot, attempt.verdict)
    return describe_failure(attempt.proposal.finish_reason)


def format_verdict(shot: int, verdict: Verdict | None) -> str:
    """The stages that a proposal passed, and its actions or the reason of the rejection; None: there was no shot."""
    match verdict:
        case Accepted(contract):
            steps = " → ".join(action_in_words(action.skill, action.params) for action in contract.action_sequence)
            return f"shot {shot}: accepted, {_format_passed_stages(len(STAGES))}: {steps}"
        case Rejected(stage=stage, pointer=pointer, got=got, allowed=_, hint=hint):
            passed = _format_passed_stages(STAGES.index(stage))
            return f"shot {shot}: rejected, {passed}{stage} ✗ at {pointer or '/'}: got {got!r}; {hint}"
        case None:
            return "no shot was taken"


def _format_passed_stages(count: int) -> str:
    return " ".join(f"{stage} ✓" for stage in STAGES[:count]) + (" " if 0 < count < len(STAGES) else "")
