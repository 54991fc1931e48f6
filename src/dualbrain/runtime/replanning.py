"""Replanning after a contract that failed or was taken over: the reason enters the next prompt.

Each try is a separate episode in memory and on disk, with its own outcome, Δ and contract. There are at most `tries`
of them, and the instruction is judged on ground truth once, at its end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dualbrain.records import Episode, FailureFeedback, Outcome

RETRIABLE_OUTCOMES = ("failed", "taken_over")
"""Outcomes after which another contract may be tried. A stop by a person, a fault, a rejection of the last proposal and
a planner that declines end the instruction."""


@dataclass(frozen=True, slots=True)
class Try:
    """One try of an instruction: its `name`, the `tries_left` with this one, and the feedback on the try before."""

    name: str
    tries_left: int
    failure_feedback: FailureFeedback | None = None


def should_retry(outcome: Outcome, tries_left: int) -> bool:
    """Whether another contract is tried after `outcome`, where `tries_left` counts the try that has just ended."""
    return tries_left > 1 and outcome.kind in RETRIABLE_OUTCOMES


def successive_tries(name: str, tries: int, finished: Sequence[Episode]) -> Iterator[Try]:
    """The tries of the instruction `name`, one after another; the caller appends each episode to `finished`.

    The first try has the instruction's name, the others the name with their number.
    """
    yield Try(name, tries)
    while should_retry(finished[-1].outcome, tries - len(finished) + 1):
        number = len(finished) + 1
        yield Try(f"{name}.{number}", tries - number + 1, failure_feedback_of(finished[-1]))


def failure_feedback_of(episode: Episode) -> FailureFeedback:
    """Feedback on `episode` for the next prompt: completed actions, failed action, reason, constraints."""
    actions: list[dict[str, Any]] = (episode.contract or {}).get("action_sequence", [])
    pairs = list(zip(map(format_action, actions), episode.outcome.actions, strict=False))
    done = tuple(action for action, result in pairs if result.status == "done")
    failed_action = next((action for action, result in pairs if result.status not in ("done", "not_run")), "")
    outcome = episode.outcome
    return FailureFeedback(
        episode_id=episode.id,
        outcome=outcome.kind,
        done=done,
        failed_action=failed_action,
        reason=outcome.reason,
        active_constraints=outcome.active_constraints,
    )


def format_action(action: dict[str, Any]) -> str:
    """An action as its skill and the names in it, such as "place blue_bowl"."""
    params: dict[str, Any] = action.get("params", {})
    names = [str(params[key]) for key in ("object", "target", "destination", "place") if key in params]
    return " ".join((str(action.get("skill")), *names))
