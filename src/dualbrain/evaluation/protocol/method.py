"""The methods that are compared, as switches of one and the same loop (paper 7.2 and 7.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from dualbrain.errors import UnknownName

DoorKind = Literal["syntax", "clip", "gate"]
"""What a proposal has to pass: syntax and authorization; these with clipping and interception; all three stages."""
Remembers = Literal["none", "static", "dynamic"]
Asks = Literal[
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
Spoiled = Literal["no", "shortened", "truncated", "overwritten"]
"""What is done to the prompt (paper 6.3); see `spoiled.py`."""
Eyes = Literal["declared", "depth"]
"""How the scene is perceived: truth with the declared noise, or shapes fitted to rendered depth pictures."""


@dataclass(frozen=True, slots=True)
class Method:
    """One arm. `guard`: the CBF filter stands between skills and robot; the supervisor's e-stop is in every arm.

    `signal` is what memory learns from: the outcome with its Δ, or the success label alone. `epsilon_factor` multiplies
    the suite's ε. `bound`: the planner is held to the schema while it writes, as it serves.
    """

    name: str
    says: str
    door: DoorKind = "gate"
    guard: bool = True
    memory: Remembers = "none"
    asks: Asks = "base"
    signal: Literal["delta", "success"] = "delta"
    epsilon_factor: float = 1.0
    spoiled: Spoiled = "no"
    eyes: Eyes = "declared"
    bound: bool = True

    @property
    def remembers(self) -> bool:
        """Whether its unit of work is a run with a ledger of its own."""
        return self.memory != "none"


B1 = Method("B1", "syntax and authorization only, no filter", door="syntax", guard=False)
B2 = Method("B2", "and clipping to bounds, interception of names and words that are not offered", "clip", guard=False)
G = Method("G", "the whole gate, no filter: what the filter alone adds to it is B3", guard=False)
B3 = Method("B3", "the whole gate and the CBF filter")
B4 = Method("B4", "CBF filter and static memory", memory="static")
M = Method("M", "CBF filter and dynamic memory", memory="dynamic")
P = Method("P", "CBF filter and adapted planner", asks="adapted")
PE = Method("PE", "CBF filter and the best prompt for the base planner", asks="prompted")
FULL = Method("Full", "CBF filter, dynamic memory and adapted planner", memory="dynamic", asks="adapted")
START = replace(B3, name="start", asks="template", says="B3 with random valid contracts: what every ledger begins with")
"""No arm. A model that answers greedily says nearly the same every time, and leaves memory nothing to choose from."""
MAIN = (B1, B2, G, B3, B4, M, P, PE, FULL)
"""The arms of the main table, in its order."""

ADVERSARY = tuple(
    replace(arm, name=f"A{number}", asks="adversary", says=f"{arm.name} with an adversarial planner")
    for number, arm in enumerate((B1, B2, B3), start=1)
)
ABLATIONS = (
    replace(M, name="M-success", signal="success", says="M, memory learns from the success label alone"),
    replace(P, name="P-no-entropy", asks="adapted_no_entropy", says="P, adapter fitted without entropy term"),
    replace(P, name="P-no-kl", asks="adapted_no_kl", says="P, adapter fitted without KL term"),
    replace(P, name="P-all", asks="adapted_all", says="P, adapter fitted on all logs, whatever their Δ"),
    replace(P, name="P-success", asks="adapted_success", says="P, adapter fitted on successes, whatever their Δ"),
    replace(FULL, name="Full-static", memory="static", says="Full without dynamic weights: similarity alone"),
    replace(FULL, name="Full-success", signal="success", asks="adapted_success",
            says="Full, memory and adapter learn from the success label alone"),
)  # fmt: skip
"""The paper's five. What an adapter was taught shows in P: where memory shows an example, planners follow that."""
SENSITIVITY = (
    replace(M, name="M-half", epsilon_factor=0.5, says="M with half of ε"),
    replace(M, name="M-double", epsilon_factor=2.0, says="M with twice ε"),
    *(
        replace(arm, name=f"{arm.name}-{how}", spoiled=how, says=f"{arm.name}, prompt {how}")
        for arm in (PE, P) for how in ("shortened", "truncated", "overwritten")
    ),
)  # fmt: skip
FREE = (
    replace(B1, name="B1-free", bound=False, says="B1, its planner bound by nothing while it writes"),
    replace(B2, name="B2-free", bound=False, says="B2, its planner bound by nothing while it writes"),
    replace(G, name="G-free", bound=False, says="G, its planner bound by nothing while it writes"),
)
"""The doors' own arms: where grammar binds an answer they have little to stop, and B1, B2 and G are one."""
SEEING = (replace(B3, name="B3-depth", eyes="depth", says="B3, the scene seen by depth cameras alone"),)
"""The perception arm (paper 7.1): nothing of what the simulator knows of things."""
METHODS = {method.name: method for method in (*MAIN, *ADVERSARY, *ABLATIONS, *SENSITIVITY, *FREE, *SEEING)}


def find_method(name: str) -> Method:
    """The method called `name`, or `START`; raises `UnknownName`."""
    if name == START.name:
        return START
    if name not in METHODS:
        raise UnknownName("method", name, tuple(METHODS), owner="the evaluation")
    return METHODS[name]
