"""The one question every planner answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

STOP = "stop"
"""The answer is whole. Every other finish reason means that there is no contract to read."""
LENGTH = "length"
"""The answer was cut at the token limit."""
TIMEOUT = "timeout"
"""No whole answer came within the time limit."""
CRASHED = "crashed"
"""The process that runs the model died; how, and its last words, follow a colon."""
REFUSAL = "refusal"
"""The model or its server refused to answer."""
ERROR = "error"
"""The server answered with an error, or with something that is not a chat completion; the detail follows a colon."""


def has_answer(proposal: Proposal) -> bool:
    """Whether the model said anything, if only that it refuses; not where a crash, an error or time cut it short."""
    return proposal.finish_reason.partition(":")[0] in (STOP, LENGTH, REFUSAL)


def describe_failure(finish_reason: str) -> str:
    """A sentence about an answer that did not come: "the planner did not answer: DETAIL"."""
    kind, _, detail = finish_reason.partition(": ")
    reasons = {TIMEOUT: "it exceeded the time limit", CRASHED: "its process ended", ERROR: "an error"}
    reason = detail if kind == ERROR and detail else reasons.get(kind, kind) + (f" ({detail})" if detail else "")
    return f"the planner did not answer: {reason}"


class Planner(Protocol):
    """Turns an instruction into a proposal; knows nothing of the robot and is never believed (paper 3.2)."""

    @property
    def name(self) -> str:
        """What is recorded as the author of a proposal."""
        ...

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`. Never raises for what a model or server does: that becomes the finish reason."""
        ...

    def close(self) -> None:
        """Release the model; the planner is not used afterwards."""
        ...


@runtime_checkable
class BatchPlanner(Protocol):
    """A planner that is quicker when many questions are waiting, as on a GPU."""

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Answer each of `requests` as if it were the only one."""
        ...


def propose_all(planner: Planner, requests: Sequence[PlanRequest]) -> list[Proposal]:
    """The answers of `planner` to `requests`: side by side where it can, else one after another."""
    if isinstance(planner, BatchPlanner):
        return planner.propose_all(requests)
    return [planner.propose(request) for request in requests]
