"""D_clean (paper 6.1): which episodes may teach, and for each other one the first reason why it may not."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from statistics import median

import msgspec

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import ConfigurationError
from dualbrain.memory.plasticity.rule import EPSILON

PRINCIPAL = "planner"


class CleanRules(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """D_clean = {i : valid, r_i = 1, Δ_i ≤ ε}, of memories that are believed, and not much slower than their kind.

    `epsilon` is the memory's own ε. `slowest` is how many times the median duration of the successes of its family
    (its skills in order) an episode may take; dawdling keeps Δ low and must not be learnt. Without `physical` nothing
    is selected by what came of it, nor by whether memory believes that: all that was proposed and is valid and that
    nobody has set aside (an ablation, paper 7.4).
    """

    epsilon: float = EPSILON
    slowest: float = 1.5
    physical: bool = True

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for an ε below 0, a limit that would leave out the median, or an endless one."""
        if not 0.0 <= self.epsilon < math.inf:
            raise ConfigurationError("epsilon", got=self.epsilon, allowed="at least 0 and finite")
        if not 1.0 <= self.slowest < math.inf:
            raise ConfigurationError("slowest", got=self.slowest, allowed="at least 1 and finite")


def select(
    candidates: Sequence[Candidate],
    registry: SkillRegistry,
    rules: CleanRules,
    declines: Collection[str] = (),
    site: SkillRegistry | None = None,
) -> tuple[list[Candidate], dict[str, list[str]]]:
    """The episodes of D_clean in their order, and the ids of all others by the reason that excludes them.

    Every contract is judged again by today's gate: syntax, authorization, and of the envelope the bounds and names. The
    rules that need the scene's geometry and the body (`grounding/scene_rules.py`) are not asked again: the whole gate accepted
    the contract before it was flown, and r is the body's own word. Simulator truth is not in the ledger. A decline has
    no r: those that are named in `declines` are let in on the word of whoever asked. With `site`, which only narrows
    `registry`, episodes of either may teach what its gate accepts.
    """
    here = site or registry
    gate, known = Gate(here, {PRINCIPAL: frozenset(here.by_name)}), (registry.hash, here.hash)
    left_out = defaultdict[str, list[str]](list)
    good: list[Candidate] = []
    for one in candidates:
        proved = not rules.physical or (one.memory.kind == "declined" and one.memory.id in declines)
        if reason := _exclusion_reason(one, registry.robot, known, rules, outcome_waived=proved) or _gate_rejection(
            one, here, gate
        ):
            left_out[reason].append(one.memory.id)
        else:
            good.append(one)
    if not rules.physical:
        return good, dict(left_out)
    limits = _duration_limits(good, rules.slowest)
    for one in good:
        if one.duration > limits[one.skill_sequence]:
            left_out[f"slower than {rules.slowest:g} times the median of its family"].append(one.memory.id)
    return [one for one in good if one.duration <= limits[one.skill_sequence]], dict(left_out)


def _exclusion_reason(
    one: Candidate, robot: str, known: Collection[str], rules: CleanRules, *, outcome_waived: bool
) -> str:
    """The first rule that excludes `one` by what the ledger says of it; "" if none does.

    What needs no proof (`proved`) needs no success and no Δ: a right decline moves nothing.
    """
    memo = one.memory
    checks = (
        (memo.robot == robot, "of another robot"),
        (memo.status == "active" or (not rules.physical and memo.status == "candidate"), f"{memo.status} in memory"),
        (outcome_waived or memo.kind == "succeeded", f"outcome {memo.kind}"),
        (memo.registry in known, "of another registry"),
        (one.was_filtered, "flown without the safety filter"),
        (bool(one.instruction.strip()), "without an instruction"),
        (outcome_waived or _is_within_epsilon(memo.Delta, rules.epsilon), f"Δ above {rules.epsilon:g}"),
        (math.isfinite(one.duration), "without a duration"),
    )
    return next((reason for holds, reason in checks if not holds), "")


def _is_within_epsilon(Delta: float | None, epsilon: float) -> bool:
    """Whether Δ is at most ε; a success that took no tick (home, from there) has none, and nothing was corrected."""
    return Delta is None or 0.0 <= Delta <= epsilon


def _gate_rejection(one: Candidate, registry: SkillRegistry, gate: Gate) -> str:
    """Why the gate would refuse the contract today; "" if it would not."""
    if one.contract is None or not all(action.skill in registry.by_name for action in one.contract.action_sequence):
        return "without a contract of this vocabulary"
    text = canonical_contract(with_registry(one.contract, registry), registry).encode()
    verdict = gate.check(text, names=one.scene_names, principal=PRINCIPAL, now=0.0)
    return f"refused by the gate: {verdict.stage}" if isinstance(verdict, Rejected) else ""


def with_registry(contract: Contract, registry: SkillRegistry) -> Contract:
    """`contract` as it would have been written for `registry`, whose words it uses."""
    return msgspec.structs.replace(contract, context=msgspec.structs.replace(contract.context, registry=registry.hash))


def _duration_limits(good: Sequence[Candidate], slowest: float) -> dict[tuple[str, ...], float]:
    """The longest duration [s] of each family."""
    durations = defaultdict[tuple[str, ...], list[float]](list)
    for one in good:
        durations[one.skill_sequence].append(one.duration)
    return {family: slowest * median(values) for family, values in durations.items()}
