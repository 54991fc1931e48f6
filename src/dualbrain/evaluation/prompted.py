"""The best prompt that we can write for a planner whose own prompt holds no examples (paper 7.4, arm PE).

A full prompt has worked examples in it. The short one of an adapted planner has none, but such a planner was taught to
follow what memory shows it; so worked examples that suit the scene are shown as if memory had recalled them.
"""

from __future__ import annotations

import msgspec

from dualbrain.planner.prompt import worked_examples
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.planner.short_prompt import MAX_SHOWN
from dualbrain.records import Proposal, Recall


class PromptedPlanner:
    """Asks `planner` with worked examples where nothing was recalled; its name says so."""

    def __init__(self, planner: Planner) -> None:
        """Show examples before each question."""
        self._planner = planner

    @property
    def name(self) -> str:
        """The planner's, with what it is shown."""
        return f"{self._planner.name}, with worked examples"

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer to the question with examples before it."""
        return self._planner.propose(with_examples(request))

    def close(self) -> None:
        """Close the planner."""
        self._planner.close()


def with_examples(request: PlanRequest) -> PlanRequest:
    """`request` with worked examples that suit it, unless memory has recalled something."""
    if request.recall.exemplars:
        return request
    return msgspec.structs.replace(request, recall=Recall(worked_examples(request, MAX_SHOWN)))
