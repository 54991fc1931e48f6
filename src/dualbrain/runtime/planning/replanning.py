"""Replanning after a contract that failed or was taken over: the reason enters the next prompt.

Each try is a separate episode in memory and on disk, with its own outcome, Δ and contract. There are at most `tries`
of them, and the instruction is judged on ground truth once, at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dualbrain.contracts.contract import action_in_words
from dualbrain.records import Episode, FailureFeedback, Outcome

RETRIABLE_OUTCOMES = ("failed", "taken_over")
"""Outcomes after which another contract may be tried. A stop by a person, a fault, a rejection of the last proposal and
a planner that declines end the instruction."""


@dataclass(frozen=True, slots=True)
class Try:
    """One try of an instruction: its `name`, the `tries_left` with this one, and the feedback on the try before.

    `continuation` are the actions of the try before that its held object still allows, see `continuation_of`.
    """

    name: str
    tries_left: int
    failure_feedback: FailureFeedback | None = None
    continuation: tuple[dict[str, Any], ...] = ()


def should_retry(outcome: Outcome, tries_left: int, *, machine_was_busy: bool = False) -> bool:
    """Whether another contract is tried after `outcome`, where `tries_left` counts the try that has just ended.

    With `machine_was_busy`, which only a simulated robot may state, a contract that a fault has stopped is tried again.
    """
    retriable = (*RETRIABLE_OUTCOMES, "stopped") if machine_was_busy else RETRIABLE_OUTCOMES
    return tries_left > 1 and outcome.kind in retriable


def successive_tries(
    name: str,
    tries: int,
    finished: Sequence[Episode],
    held: Callable[[], str | None] = lambda: None,
    machine_was_busy: Callable[[], bool] = lambda: False,
) -> Iterator[Try]:
    """The tries of the instruction `name`, one after another; the caller appends each episode to `finished`.

    The first try has the instruction's name, the others the name with their number. `held` returns the name of the
    object in the hand at that time, `machine_was_busy` whether a busy machine can have ended the last try.
    """
    yield Try(name, tries)
    while should_retry(finished[-1].outcome, tries - len(finished) + 1, machine_was_busy=machine_was_busy()):
        number = len(finished) + 1
        last, load = finished[-1], held()
        yield Try(f"{name}.{number}", tries - number + 1, failure_feedback_of(last, load), continuation_of(last, load))


def continuation_of(episode: Episode, held: str | None) -> tuple[dict[str, Any], ...]:
    """The actions of the failed contract of `episode` that remain for the object `held`; empty if none can follow.

    A failed grasp whose object is nevertheless held needs no repetition: the actions after it remain. Another failed
    action with a load remains with the actions after it.
    """
    actions: list[dict[str, Any]] = (episode.contract or {}).get("action_sequence", [])
    results = episode.outcome.actions
    failed = next((index for index, one in enumerate(results) if one.status not in ("done", "not_run")), None)
    if held is None or failed is None or failed >= len(actions):
        return ()
    is_its_grasp = actions[failed].get("skill") == "grasp" and actions[failed].get("params", {}).get("object") == held
    return tuple(actions[failed + 1 :] if is_its_grasp else actions[failed:])


def failure_feedback_of(episode: Episode, held: str | None = None) -> FailureFeedback:
    """Feedback on `episode` for the next prompt: completed actions, failed action, reason, constraints, object held."""
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
        held=held or "",
    )


def format_action(action: dict[str, Any]) -> str:
    """An action as its skill and the names in it, such as "place blue_bowl"."""
    return action_in_words(action.get("skill"), action.get("params", {}))
