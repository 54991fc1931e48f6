"""Planning again after a contract that failed or was taken over: the reason goes into the next question.

Each try is an episode of its own in memory and on disk, with its own outcome class, Δ and contract; what leads from one
to the next is a value. There are at most `tries` of them, and the errand is judged on truth once, at its end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dualbrain.memory.memory import StoreReport
from dualbrain.records import Episode, FailureFeedback, Outcome

RETRIABLE_OUTCOMES = ("failed", "taken_over")
"""Outcomes after which another contract may be tried. A person's hand and a fault end the errand, and so do a refusal
by the gate after the last shot and a planner that declines."""
TryResult = tuple[Episode, StoreReport]


def should_retry(outcome: Outcome, tries: int) -> bool:
    """Whether another contract is to be tried after `outcome`, where `tries` may still be made, this one included."""
    return tries > 1 and outcome.kind in RETRIABLE_OUTCOMES


def failure_feedback_of(episode: Episode) -> FailureFeedback:
    """What the next question says of `episode`: what was done, what was not, why, and what stood in the way."""
    actions: list[dict[str, Any]] = (episode.contract or {}).get("action_sequence", [])
    pairs = list(zip(map(format_action, actions), episode.outcome.actions, strict=False))
    done = tuple(words for words, result in pairs if result.status == "done")
    undone = next((words for words, result in pairs if result.status not in ("done", "not_run")), "")
    outcome = episode.outcome
    return FailureFeedback(
        episode_id=episode.id,
        outcome=outcome.kind,
        done=done,
        undone=undone,
        reason=outcome.reason,
        hindrance=outcome.hindrance,
    )


def format_action(action: dict[str, Any]) -> str:
    """An action by its skill and the names in it, such as "place blue_bowl"."""
    params: dict[str, Any] = action.get("params", {})
    names = [str(params[key]) for key in ("object", "target", "destination", "place") if key in params]
    return " ".join((str(action.get("skill")), *names))


def run_tries(
    name: str, tries: int, run: Callable[[str, int, FailureFeedback | None], TryResult]
) -> tuple[TryResult, ...]:
    """All tries of the errand `name`, in their order; `run` makes one of (its name, tries left, what came before).

    The first has the errand's name, the others the name with their number.
    """
    done = [run(name, tries, None)]
    while should_retry(done[-1][0].outcome, tries - len(done) + 1):
        number = len(done) + 1
        done.append(run(f"{name}.{number}", tries - number + 1, failure_feedback_of(done[-1][0])))
    return tuple(done)
