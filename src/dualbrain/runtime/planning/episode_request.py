"""The request of one episode: an instruction, and the limits on what may be done for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from dualbrain.control.executor import Grants
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.records import FailureFeedback, GripProfile, Scene

InstructionCheck = Literal["all", "before_planning", "given_contract"]
"""Which checks an instruction passes.

all: the review before planning, and the comparison of the contract with the words. before_planning: the review alone,
for planners whose answers do not depend on the words and that measure the gate and the filter. given_contract: a person
chose the contract and the words are a label; stop commands and hostile words still count.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRequest:
    """One instruction and the limits on its episode.

    `started` is its date (ISO 8601), `now` [s, 1970 UTC] the time under which memory stores it. The planner has
    `max_shots` proposals and is shown at most `max_exemplars` memories (0: neither exemplars nor warnings, as for a
    given contract). `tries_left` contracts may still be executed for the instruction, this one included;
    `failure_feedback` is the feedback on the one before, `continuation` the actions that remain of it for the object in
    the hand: if the gate rejects every proposal, or the planner declines, the gate gets a contract of these actions.
    `first_scene` is the scene in which the instruction was given, if an earlier contract may have changed it, and
    `first_held` the object in the hand at that time; `earlier_grips` are the grips of the hand since then. `grants`
    defines which principal may call which skills; by default the planner may call all of them.
    """

    id: str
    started: str
    instruction: str
    seed: int
    now: float = 0.0
    max_shots: int = 2
    max_exemplars: int = MAX_RECALLED
    reuse_contracts: bool = False
    """Whether a contract that succeeded in this place answers the instruction instead of the planner."""
    tries_left: int = 1
    failure_feedback: FailureFeedback | None = None
    continuation: tuple[dict[str, Any], ...] = ()
    grants: Grants | None = None
    first_scene: Scene | None = None
    first_held: str = ""
    earlier_grips: tuple[GripProfile, ...] = ()
    machine_was_busy: Callable[[], bool] = lambda: False
    """Whether a busy machine can have ended the contract of a simulated robot; see `should_retry`."""
    instruction_check: InstructionCheck = "all"
    """Which checks of the words the instruction and the contract pass."""
