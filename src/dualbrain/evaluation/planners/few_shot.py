"""The best prompt that we can write for a planner whose own prompt holds no examples (paper 7.4, arm PE).

A full prompt has worked examples in it. The short one of an adapted planner has none, but such a planner was taught to
follow what memory shows it first; so the worked example that suits the scene best is shown as if memory had recalled
it. More of them do harm: with a refusal among the examples it refuses.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.planner.prompt.full_prompt import worked_examples
from dualbrain.planner.protocol import Planner, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal, RetrievedContext

N_EXAMPLES = 1
"""Examples."""


class FewShotPlanner:
    """Asks `planner` with a worked example where nothing was recalled; its name says so."""

    def __init__(self, planner: Planner) -> None:
        """Show an example before each question."""
        self._planner = planner

    @property
    def name(self) -> str:
        """The planner's, with what it is shown."""
        return f"{self._planner.name}, with a worked example"

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer to the question with an example before it."""
        return self._planner.propose(with_example(request))

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """The same, for many questions."""
        return propose_all(self._planner, [with_example(request) for request in requests])

    def close(self) -> None:
        """Close the planner."""
        self._planner.close()


def with_example(request: PlanRequest) -> PlanRequest:
    """`request` with the worked example that suits it best, unless memory has recalled something."""
    if request.recall.exemplars:
        return request
    return msgspec.structs.replace(request, recall=RetrievedContext(worked_examples(request, N_EXAMPLES)))
