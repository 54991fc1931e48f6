"""The best prompt for a planner whose own prompt contains no examples (paper 7.4, method PE).

The full prompt contains worked examples. The short prompt of an adapted planner has none, but such a planner was
trained to follow the first example that memory shows; so the worked example that fits the scene best is shown as if
memory had retrieved it. More examples do harm: with a refusal among them, the planner refuses.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.planner.prompt.full_prompt import worked_examples
from dualbrain.planner.protocol import Planner, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal, RetrievedContext

N_EXAMPLES = 1
"""Number of worked examples."""


class FewShotPlanner:
    """Adds a worked example to requests without retrieved memories; its name notes the example."""

    def __init__(self, planner: Planner) -> None:
        """Add an example to the requests to `planner`."""
        self._planner = planner

    @property
    def name(self) -> str:
        """The planner's name with the note about the example."""
        return f"{self._planner.name}, with a worked example"

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer to the request with an example."""
        return self._planner.propose(with_example(request))

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """The answers to the requests with an example."""
        return propose_all(self._planner, [with_example(request) for request in requests])

    def close(self) -> None:
        """Close the planner."""
        self._planner.close()


def with_example(request: PlanRequest) -> PlanRequest:
    """`request` with the worked example that fits it best, unless memory has retrieved examples."""
    if request.recall.exemplars:
        return request
    return msgspec.structs.replace(request, recall=RetrievedContext(worked_examples(request, N_EXAMPLES)))
