"""D_clean (paper 6.1): the selection of episodes for training, and the first exclusion reason of each other episode."""

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
from dualbrain.memory.plasticity.hebbian_update import EPSILON

PRINCIPAL = "planner"


class CleanRules(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """D_clean = {i : valid, r_i = 1, Δ_i ≤ ε}, of active memories only, and without unusually slow episodes.

    `epsilon` is ε of the memory. `slowest` limits the duration of an episode to so many times the median of all
    successes with the same skills in order: slow motion keeps Δ low and must not be learnt. Without `physical`, neither
    the outcome nor the memory's confirmation is a criterion: all valid contracts are selected except those of
    quarantined or forgotten memories (an ablation, paper 7.4).
    """

    epsilon: float = EPSILON
    slowest: float = 1.5
    physical: bool = True

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for ε below 0, a limit below the median, or an infinite value."""
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
    writers: Collection[str] = (),
) -> tuple[list[Candidate], dict[str, list[str]]]:
    """The episodes of D_clean in their order, and the ids of all others by the reason that excludes them.

    Every contract is checked again by the present gate: syntax, authorization, bounds and names. The rules on scene
    geometry and robot (`grounding/envelope/scene_rules.py`) are not checked again: the complete gate accepted the
    contract before its execution, and r is the robot's own measurement. Simulator ground truth is not in the ledger. A
    decline has no r: those in `declines` are selected on the caller's authority. With `site`, which only narrows
    `registry`, episodes of either vocabulary are selected if the site's gate accepts them. With `writers`, the episodes
    of a shared ledger are selected that one of these robots wrote.
    """
    here = site or registry
    gate, known = Gate(here, {PRINCIPAL: frozenset(here.by_name)}), (registry.hash, here.hash)
    left_out = defaultdict[str, list[str]](list)
    good: list[Candidate] = []
    for one in candidates:
        waived = not rules.physical or (one.memory.kind == "declined" and one.memory.id in declines)
        if reason := (
            _writer_reason(one, writers)
            or _exclusion_reason(one, registry.robot, known, rules, outcome_waived=waived)
            or _gate_rejection(one, here, gate)
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


def _writer_reason(one: Candidate, writers: Collection[str]) -> str:
    """Why the robot that wrote `one` into a shared ledger excludes it; "" if it is one of `writers`, or all are."""
    return "" if not writers or one.memory.writer in writers else "of a robot that use_memories_of does not name"


def _exclusion_reason(
    one: Candidate, robot: str, known: Collection[str], rules: CleanRules, *, outcome_waived: bool
) -> str:
    """The first rule that excludes `one` by its record in the ledger; "" if none does.

    With `outcome_waived` neither success nor Δ is required: a correct decline moves nothing.
    """
    memory = one.memory
    checks = (
        (memory.robot == robot, "of another robot"),
        (
            memory.status == "active" or (not rules.physical and memory.status == "candidate"),
            f"{memory.status} in memory",
        ),
        (outcome_waived or memory.kind == "succeeded", f"outcome {memory.kind}"),
        (memory.registry in known, "of another registry"),
        (one.was_filtered, "executed without the safety filter"),
        (bool(one.instruction.strip()), "without an instruction"),
        (outcome_waived or _is_within_epsilon(memory.Delta, rules.epsilon), f"Δ above {rules.epsilon:g}"),
        (math.isfinite(one.duration), "without a duration"),
    )
    return next((reason for holds, reason in checks if not holds), "")


def _is_within_epsilon(Delta: float | None, epsilon: float) -> bool:
    """Whether Δ is at most ε. A success that needed no control tick has no Δ, and nothing was corrected."""
    return Delta is None or 0.0 <= Delta <= epsilon


def _gate_rejection(one: Candidate, registry: SkillRegistry, gate: Gate) -> str:
    """Why the present gate rejects the contract; "" if it accepts it."""
    if one.contract is None or not all(action.skill in registry.by_name for action in one.contract.action_sequence):
        return "without a contract of this vocabulary"
    text = canonical_contract(with_registry(one.contract, registry), registry).encode()
    verdict = gate.check(text, names=one.scene_names, principal=PRINCIPAL, now=0.0)
    return f"refused by the gate: {verdict.stage}" if isinstance(verdict, Rejected) else ""


def with_registry(contract: Contract, registry: SkillRegistry) -> Contract:
    """`contract` with the hash of `registry`, whose vocabulary it uses."""
    return msgspec.structs.replace(contract, context=msgspec.structs.replace(contract.context, registry=registry.hash))


def _duration_limits(good: Sequence[Candidate], slowest: float) -> dict[tuple[str, ...], float]:
    """The longest accepted duration [s] of each sequence of skills."""
    durations = defaultdict[tuple[str, ...], list[float]](list)
    for one in good:
        durations[one.skill_sequence].append(one.duration)
    return {family: slowest * median(values) for family, values in durations.items()}
