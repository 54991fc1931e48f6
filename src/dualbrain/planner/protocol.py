"""The protocol of planners, and the finish reasons of their proposals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

STOP = "stop"
"""The answer is complete. With every other finish reason there is no contract to read."""
LENGTH = "length"
"""The answer was cut at the token limit."""
TIMEOUT = "timeout"
"""No complete answer arrived within the time limit."""
CRASHED = "crashed"
"""The process of the model died; its exit status and the end of its standard error follow a colon."""
REFUSAL = "refusal"
"""The model or its server refused to answer."""
ERROR = "error"
"""The server answered with an error, or with something that is not a chat completion; the detail follows a colon."""


def has_answer(proposal: Proposal) -> bool:
    """Whether the model answered, which includes a refusal; False after a crash, an error or a timeout."""
    return is_answer(proposal.finish_reason)


def is_answer(finish_reason: str) -> bool:
    """Whether an answer with `finish_reason` came from the model, which includes a refusal."""
    return finish_reason.partition(":")[0] in (STOP, LENGTH, REFUSAL)


def describe_failure(finish_reason: str) -> str:
    """A sentence about a missing answer: "the planner did not answer: DETAIL"."""
    kind, _, detail = finish_reason.partition(": ")
    reasons = {TIMEOUT: "it exceeded the time limit", CRASHED: "its process ended", ERROR: "an error"}
    reason = detail if kind == ERROR and detail else reasons.get(kind, kind) + (f" ({detail})" if detail else "")
    return f"the planner did not answer: {reason}"


class Planner(Protocol):
    """Maps an instruction to a proposal; it has no access to the robot, and its proposals are untrusted (paper 3.2)."""

    @property
    def name(self) -> str:
        """Name that is recorded as the author of a proposal."""
        ...

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; a failure of the model or the server becomes the finish reason and raises nothing."""
        ...

    def close(self) -> None:
        """Release the model; the planner cannot be used afterwards."""
        ...


@runtime_checkable
class BatchPlanner(Protocol):
    """A planner that is faster for several requests at once, for example on a GPU."""

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Answer each of `requests` as if it were the only one."""
        ...


@runtime_checkable
class StreamingPlanner(Protocol):
    """A planner that reports its answer while it is generated."""

    def show_answers(self, show: Callable[[str], None]) -> None:
        """Call `show` with the text of each answer while it grows; the text is incomplete and for display only."""
        ...


def show_answers(planner: Planner, show: Callable[[str], None]) -> None:
    """Let `planner` call `show` while it answers, if it can; see `StreamingPlanner`."""
    if isinstance(planner, StreamingPlanner):
        planner.show_answers(show)


def propose_all(planner: Planner, requests: Sequence[PlanRequest]) -> list[Proposal]:
    """The answers of `planner` to `requests`: in a batch if it supports this, otherwise one after another."""
    if isinstance(planner, BatchPlanner):
        return planner.propose_all(requests)
    return [planner.propose(request) for request in requests]
