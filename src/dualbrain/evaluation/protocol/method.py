"""The compared methods, as settings of one and the same loop (paper 7.2 and 7.4)."""

from __future__ import annotations

from typing import Literal

import msgspec
from msgspec.structs import replace

from dualbrain.errors import UnknownNameError

GateKind = Literal["syntax", "clip", "gate"]
"""Checks that a proposal must pass: syntax and authorization; these with clipping and interception; all stages."""
MemoryKind = Literal["none", "static", "dynamic"]
PlannerRole = Literal[
    "base",
    "prompted",
    "prompted_fixed",
    "adapted",
    "adapted_no_entropy",
    "adapted_no_kl",
    "adapted_all",
    "adapted_success",
    "adversary",
    "template",
    "value",
]
"""Which of the suite's planners answers; `adversary` and `template` draw random answers and are not named in
suites."""
PromptCorruption = Literal["no", "shortened", "truncated", "overwritten"]
"""Corruption of the prompt (paper 6.3); see `planners/corrupted_prompt.py`."""
PerceptionKind = Literal["declared", "depth"]
"""Perception of the scene: ground truth with the declared noise, or shapes fitted to rendered depth images."""


ENCODED_NAMES = {
    "description": "says",
    "gate": "door",
    "planner_role": "asks",
    "prompt_corruption": "spoiled",
    "perception": "eyes",
    "constrained": "bound",
}
"""Names of fields in the configuration stored with results, unchanged since version 0.1."""


class Method(msgspec.Struct, frozen=True, rename=ENCODED_NAMES, kw_only=True):
    """One method. `guard`: the CBF filter is between skills and robot; every method has the supervisor's e-stop.

    `signal`: memory learns from the outcome with its Δ, or from the success label alone. `epsilon_factor` multiplies
    the suite's ε. `constrained`: decoding is constrained to the contract schema, as in service. `reuse_contracts`: a
    contract that succeeded in this place answers instead of the planner.
    """

    name: str
    description: str
    gate: GateKind = "gate"
    guard: bool = True
    memory: MemoryKind = "none"
    planner_role: PlannerRole = "base"
    signal: Literal["delta", "success"] = "delta"
    epsilon_factor: float = 1.0
    prompt_corruption: PromptCorruption = "no"
    perception: PerceptionKind = "declared"
    constrained: bool = True
    reuse_contracts: bool = False

    @property
    def uses_memory(self) -> bool:
        """Whether the method's unit of work is a run with its own ledger."""
        return self.memory != "none"


B1 = Method(name="B1", description="syntax and authorization only, no filter", gate="syntax", guard=False)
B2 = Method(
    name="B2",
    description="B1, with clipping to bounds, and interception of unknown names and choices",
    gate="clip",
    guard=False,
)
G = Method(name="G", description="the full gate, no filter (B3 without the filter)", guard=False)
B3 = Method(name="B3", description="the full gate and the CBF filter")
B4 = Method(name="B4", description="CBF filter and static memory", memory="static")
M = Method(name="M", description="CBF filter and dynamic memory", memory="dynamic")
P = Method(name="P", description="CBF filter and adapted planner", planner_role="adapted")
PE = Method(name="PE", description="CBF filter and the best prompt for the base planner", planner_role="prompted")
PE_FIXED = replace(
    PE,
    name="PE-fixed",
    planner_role="prompted_fixed",
    description="PE, the worked example with the best fixed contract of an exploration",
)
V = Method(name="V", description="CBF filter and the choice of a value model, no language model", planner_role="value")
FULL = Method(
    name="Full", description="CBF filter, dynamic memory and adapted planner", memory="dynamic", planner_role="adapted"
)
START_METHOD = replace(
    B3,
    name="start",
    planner_role="template",
    description="B3 with random valid contracts, for the start of every ledger",
)
"""Fills the start ledger and is not compared. A greedily decoded model would give nearly the same contract every time,
and memory would have nothing to choose from."""
MAIN_METHODS = (B1, B2, G, B3, B4, M, P, PE, FULL)
"""The methods of the main table, in its order."""

ADVERSARY_METHODS = tuple(
    replace(
        method, name=f"A{number}", planner_role="adversary", description=f"{method.name} with an adversarial planner"
    )
    for number, method in enumerate((B1, B2, B3), start=1)
)
ABLATION_METHODS = (
    replace(M, name="M-success", signal="success", description="M, memory learns from the success label alone"),
    replace(
        P, name="P-no-entropy", planner_role="adapted_no_entropy", description="P, adapter fitted without entropy term"
    ),
    replace(P, name="P-no-kl", planner_role="adapted_no_kl", description="P, adapter fitted without KL term"),
    replace(
        P, name="P-all", planner_role="adapted_all", description="P, adapter fitted on all logs, regardless of their Δ"
    ),
    replace(
        P,
        name="P-success",
        planner_role="adapted_success",
        description="P, adapter fitted on successes, regardless of their Δ",
    ),
    replace(FULL, name="Full-static", memory="static", description="Full without dynamic weights: similarity alone"),
    replace(
        FULL,
        name="Full-success",
        signal="success",
        planner_role="adapted_success",
        description="Full, memory and adapter learn from the success label alone",
    ),
)
"""The paper's five ablations. Those of the adapter use P, because planners follow the examples that memory shows."""
SENSITIVITY_METHODS = (
    replace(M, name="M-half", epsilon_factor=0.5, description="M with half of ε"),
    replace(M, name="M-double", epsilon_factor=2.0, description="M with twice ε"),
    *(
        replace(
            method,
            name=f"{method.name}-{corruption}",
            prompt_corruption=corruption,
            description=f"{method.name}, prompt {corruption}",
        )
        for method in (PE, P)
        for corruption in ("shortened", "truncated", "overwritten")
    ),
)
UNCONSTRAINED_METHODS = (
    replace(B1, name="B1-free", constrained=False, description="B1, with unconstrained decoding"),
    replace(B2, name="B2-free", constrained=False, description="B2, with unconstrained decoding"),
    replace(G, name="G-free", constrained=False, description="G, with unconstrained decoding"),
)
"""Methods that show the gates: under constrained decoding they have little to reject, and B1, B2 and G coincide."""
DEPTH_METHODS = (
    replace(B3, name="B3-depth", perception="depth", description="B3, the scene perceived by depth cameras alone"),
)
"""Methods without ground truth from the simulator in their perception (paper 7.1)."""
REUSE_METHODS = (
    replace(
        M,
        name="M-reuse",
        reuse_contracts=True,
        description="M, contracts that succeeded in this place answer without the planner",
    ),
)
"""Methods in which memory answers repeated requests without the planner, for the decision time."""
METHODS = {
    method.name: method
    for method in (
        *MAIN_METHODS,
        *ADVERSARY_METHODS,
        *ABLATION_METHODS,
        *SENSITIVITY_METHODS,
        *UNCONSTRAINED_METHODS,
        *DEPTH_METHODS,
        *REUSE_METHODS,
        PE_FIXED,
        V,
    )
}


def find_method(name: str) -> Method:
    """The method called `name`, also `START_METHOD`; raises `UnknownNameError`."""
    if name == START_METHOD.name:
        return START_METHOD
    if name not in METHODS:
        raise UnknownNameError("method", name, tuple(METHODS), owner="the evaluation")
    return METHODS[name]
