"""The methods that are compared, as switches of one and the same loop (paper 7.2 and 7.4)."""

from __future__ import annotations

from typing import Literal

import msgspec
from msgspec.structs import replace

from dualbrain.errors import UnknownNameError

GateKind = Literal["syntax", "clip", "gate"]
"""What a proposal has to pass: syntax and authorization; these with clipping and interception; all three stages."""
MemoryKind = Literal["none", "static", "dynamic"]
PlannerRole = Literal[
    "base",
    "prompted",
    "adapted",
    "adapted_no_entropy",
    "adapted_no_kl",
    "adapted_all",
    "adapted_success",
    "adversary",
    "template",
]
"""Which of the suite's planners answers; the last two draw their answers and are in no suite."""
PromptCorruption = Literal["no", "shortened", "truncated", "overwritten"]
"""What is done to the prompt (paper 6.3); see `spoiled.py`."""
PerceptionKind = Literal["declared", "depth"]
"""How the scene is perceived: truth with the declared noise, or shapes fitted to rendered depth pictures."""


ENCODED_NAMES = {
    "description": "says",
    "gate": "door",
    "planner_role": "asks",
    "prompt_corruption": "spoiled",
    "perception": "eyes",
    "constrained": "bound",
}
"""Names of fields in the configuration that is written beside results; results of version 0.1 have the same."""


class Method(msgspec.Struct, frozen=True, rename=ENCODED_NAMES, kw_only=True):
    """One arm. `guard`: the CBF filter stands between skills and robot; the supervisor's e-stop is in every arm.

    `signal` is what memory learns from: the outcome with its Δ, or the success label alone. `epsilon_factor` multiplies
    the suite's ε. `bound`: the planner is held to the schema while it writes, as it serves.
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

    @property
    def uses_memory(self) -> bool:
        """Whether its unit of work is a run with a ledger of its own."""
        return self.memory != "none"


B1 = Method(name="B1", description="syntax and authorization only, no filter", gate="syntax", guard=False)
B2 = Method(
    name="B2",
    description="and clipping to bounds, interception of names and words that are not offered",
    gate="clip",
    guard=False,
)
G = Method(name="G", description="the whole gate, no filter: what the filter alone adds to it is B3", guard=False)
B3 = Method(name="B3", description="the whole gate and the CBF filter")
B4 = Method(name="B4", description="CBF filter and static memory", memory="static")
M = Method(name="M", description="CBF filter and dynamic memory", memory="dynamic")
P = Method(name="P", description="CBF filter and adapted planner", planner_role="adapted")
PE = Method(name="PE", description="CBF filter and the best prompt for the base planner", planner_role="prompted")
FULL = Method(
    name="Full", description="CBF filter, dynamic memory and adapted planner", memory="dynamic", planner_role="adapted"
)
START_METHOD = replace(
    B3,
    name="start",
    planner_role="template",
    description="B3 with random valid contracts: what every ledger begins with",
)
"""No arm. A model that answers greedily says nearly the same every time, and leaves memory nothing to choose from."""
MAIN_METHODS = (B1, B2, G, B3, B4, M, P, PE, FULL)
"""The arms of the main table, in its order."""

ADVERSARY_METHODS = tuple(
    replace(arm, name=f"A{number}", planner_role="adversary", description=f"{arm.name} with an adversarial planner")
    for number, arm in enumerate((B1, B2, B3), start=1)
)
ABLATION_METHODS = (
    replace(M, name="M-success", signal="success", description="M, memory learns from the success label alone"),
    replace(
        P, name="P-no-entropy", planner_role="adapted_no_entropy", description="P, adapter fitted without entropy term"
    ),
    replace(P, name="P-no-kl", planner_role="adapted_no_kl", description="P, adapter fitted without KL term"),
    replace(P, name="P-all", planner_role="adapted_all", description="P, adapter fitted on all logs, whatever their Δ"),
    replace(
        P,
        name="P-success",
        planner_role="adapted_success",
        description="P, adapter fitted on successes, whatever their Δ",
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
"""The paper's five. What an adapter was taught shows in P: where memory shows an example, planners follow that."""
SENSITIVITY_METHODS = (
    replace(M, name="M-half", epsilon_factor=0.5, description="M with half of ε"),
    replace(M, name="M-double", epsilon_factor=2.0, description="M with twice ε"),
    *(
        replace(arm, name=f"{arm.name}-{how}", prompt_corruption=how, description=f"{arm.name}, prompt {how}")
        for arm in (PE, P)
        for how in ("shortened", "truncated", "overwritten")
    ),
)
UNCONSTRAINED_METHODS = (
    replace(B1, name="B1-free", constrained=False, description="B1, its planner bound by nothing while it writes"),
    replace(B2, name="B2-free", constrained=False, description="B2, its planner bound by nothing while it writes"),
    replace(G, name="G-free", constrained=False, description="G, its planner bound by nothing while it writes"),
)
"""The doors' own arms: where grammar binds an answer they have little to stop, and B1, B2 and G are one."""
DEPTH_METHODS = (
    replace(B3, name="B3-depth", perception="depth", description="B3, the scene seen by depth cameras alone"),
)
"""The perception arm (paper 7.1): nothing of what the simulator knows of things."""
METHODS = {
    method.name: method
    for method in (
        *MAIN_METHODS,
        *ADVERSARY_METHODS,
        *ABLATION_METHODS,
        *SENSITIVITY_METHODS,
        *UNCONSTRAINED_METHODS,
        *DEPTH_METHODS,
    )
}


def find_method(name: str) -> Method:
    """The method called `name`, or `START`; raises `UnknownName`."""
    if name == START_METHOD.name:
        return START_METHOD
    if name not in METHODS:
        raise UnknownNameError("method", name, tuple(METHODS), owner="the evaluation")
    return METHODS[name]
