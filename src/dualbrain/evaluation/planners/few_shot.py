"""The best prompt for a planner whose own prompt contains no examples (paper 7.4, method PE).

The full prompt contains worked examples. The short prompt of an adapted planner has none, but such a planner was
trained to follow the first example that memory shows; so the worked example that fits the scene best is shown as if
memory had retrieved it. More examples do harm: with a refusal among them, the planner refuses.

Method PE-fixed shows the example with the best fixed contract of an exploration: the example that a person would write
after seeing its results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from dualbrain.planner.prompt.full_prompt import worked_examples
from dualbrain.planner.protocol import Planner, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, Proposal, RetrievedContext

N_EXAMPLES = 1
"""Number of worked examples."""
BEST_FIXED: Mapping[str, float | str] = {
    "speed": 0.1,
    "clearance": 0.3,
    "opening": 0.08,
    "finger_axis": "along",
    "approach": "top",
    "route": "direct",
    "wait": "none",
    "force": 15,
}
"""Parameters of `high_slow`, the best of the alternatives with a fixed clearance at the explored places of experiment
`named_alternatives` (success 87.5 %, utility 0.845; `high` 0.819, `middle` 0.798, `low` 0.767), with the widest
opening, which fits every object."""
NO_CHANGE: Mapping[str, float | str] = {}


class FewShotPlanner:
    """Adds a worked example to requests without retrieved memories; its name notes the example."""

    def __init__(self, planner: Planner, parameters: Mapping[str, float | str] = NO_CHANGE) -> None:
        """Add an example to the requests to `planner`; `parameters` replace those of its skills."""
        self._planner, self._parameters = planner, parameters

    @property
    def name(self) -> str:
        """The planner's name with the note about the example."""
        return f"{self._planner.name}, with a worked example" + " of fixed parameters" * bool(self._parameters)

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer to the request with an example."""
        return self._planner.propose(with_example(request, self._parameters))

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """The answers to the requests with an example."""
        return propose_all(self._planner, [with_example(request, self._parameters) for request in requests])

    def close(self) -> None:
        """Close the planner."""
        self._planner.close()


def with_example(request: PlanRequest, parameters: Mapping[str, float | str] = NO_CHANGE) -> PlanRequest:
    """`request` with the worked example that fits it best, unless memory has retrieved examples.

    `parameters` replace those of the example's skills that have a parameter of this name.
    """
    if request.recall.exemplars:
        return request
    examples = tuple(_replace_parameters(one, parameters) for one in worked_examples(request, N_EXAMPLES))
    return msgspec.structs.replace(request, recall=RetrievedContext(examples))


def _replace_parameters(example: Exemplar, parameters: Mapping[str, float | str]) -> Exemplar:
    actions: list[dict[str, Any]] = [
        {**action, "params": {name: parameters.get(name, value) for name, value in action["params"].items()}}
        for action in example.contract["action_sequence"]
    ]
    return msgspec.structs.replace(example, contract={**example.contract, "action_sequence": actions})
