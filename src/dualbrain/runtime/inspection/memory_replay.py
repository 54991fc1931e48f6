"""Anomalous replay (paper section 8): a remembered contract is executed again in simulation, through gate and filter.

The contract is executed several times, in worlds that are rebuilt from the remembered perceived scene. The result is
the robot's own verdict with the outcome check, as in the remembered episode; ground truth does not affect memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import msgspec
import numpy as np

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.grounding.outcome.outcome_check import check_outcome, collect_evidence
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.events import ReplayFinding
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.maintenance.contradiction import agreement_p_value, is_contradicted
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.state import MemoryState
from dualbrain.records import Scene
from dualbrain.robots.loader import load_builtin_robot
from dualbrain.runtime.assembly import CellOptions, SimulatedCell, open_world
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.scenes.from_memory import scene_from_memory

POSITION_SPREAD = 0.003
"""Standard deviation of the shifts of objects between tries [m]: that of perception."""
MAX_DELTA_RATIO, MIN_DELTA = 3.0, 1e-3
"""Ratio of replayed and remembered Δ beyond which the memory is contradicted; both count as at least `MIN_DELTA`."""


class _EpisodePayload(msgspec.Struct):
    scene: Scene
    contract: dict[str, Any] | None
    instruction: str = ""


class _StoredPayload(msgspec.Struct):
    episode: _EpisodePayload
    state: Posture


@dataclass(frozen=True, slots=True)
class ReplayTry:
    """One execution: the robot's own verdict (or "refused" by the gate) as `kind`, Δ and the reason."""

    kind: str
    Delta: float | None
    reason: str

    @property
    def succeeded(self) -> bool:
        """Whether the execution succeeded by the robot's own verdict."""
        return self.kind == "succeeded"


def replay_memory(ledger: LedgerReader, memory: MemoryState, *, tries: int, seed: int, actor: str) -> ReplayFinding:
    """Execute the contract of `memory` `tries` times and compare outcome and Δ with the remembered ones.

    Raises `ConfigurationError` if the memory has no executed contract, or if its scene cannot be simulated.
    """
    stored = msgspec.json.decode(ledger.event(memory.seq).payload, type=_StoredPayload)
    if not stored.episode.contract or memory.Delta is None:
        raise ConfigurationError.stating(
            f"The memory {memory.id} ({memory.kind}) cannot be replayed.",
            fix="Name a memory whose contract was executed.",
        )
    contract = stored.episode.contract
    runs = [_run_once(stored, contract, memory.robot, np.random.default_rng([seed, number])) for number in range(tries)]
    reason, agrees = compare_with_memory(memory.r, memory.Delta, runs)
    kinds, Deltas = tuple(one.kind for one in runs), tuple(one.Delta for one in runs)
    return ReplayFinding(
        memory=memory.id,
        agrees=agrees,
        remembered=memory.kind,
        outcomes=kinds,
        Deltas=Deltas,
        reason=reason,
        actor=actor,
    )


def compare_with_memory(r: int, Delta: float, runs: list[ReplayTry]) -> tuple[str, bool]:
    """A reason in words, and whether the `runs` agree with a memory with label `r` and `Delta`.

    The memory is contradicted if too few runs agree with it (`memory.maintenance.contradiction`), or if the median Δ of
    those that agree is more than `MAX_DELTA_RATIO` times larger or smaller.
    """
    agreeing = [one for one in runs if one.succeeded == bool(r)]
    summary = f"{len(agreeing)} of {len(runs)} tries ended as remembered"
    if is_contradicted(len(agreeing), len(runs)):
        p_value = agreement_p_value(len(agreeing), len(runs))
        return f"{summary}: too few (the probability for a true memory is {p_value:.3f})", False
    Deltas = [one.Delta for one in agreeing if one.Delta is not None]
    if r and Deltas:
        middle, remembered = max(median(Deltas), MIN_DELTA), max(Delta, MIN_DELTA)
        if not 1.0 / MAX_DELTA_RATIO <= middle / remembered <= MAX_DELTA_RATIO:
            return f"{summary}, but with Δ {middle:.4f} instead of the remembered {Delta:.4f}", False
    return summary, True


def run_alternative(ledger: LedgerReader, memory: MemoryState, contract: dict[str, Any], *, seed: int) -> ReplayTry:
    """Execute another `contract` once in the world of `memory`.

    Raises `ConfigurationError` if its scene cannot be simulated.
    """
    stored = msgspec.json.decode(ledger.event(memory.seq).payload, type=_StoredPayload)
    return _run_once(stored, contract, memory.robot, np.random.default_rng([seed, memory.seq]))


def _run_once(
    stored: _StoredPayload, contract: dict[str, Any] | None, robot: str, rng: np.random.Generator
) -> ReplayTry:
    model = load_builtin_robot(robot)
    spec = scene_from_memory(stored.episode.scene, rng, position_spread=POSITION_SPREAD)
    configuration = (np.asarray(stored.state.q), stored.state.opening)
    options = CellOptions(
        perception=lambda plant: NoisyPerception(spec, PerceptionNoise(), rng), configuration=configuration
    )
    cell = SimulatedCell(model, open_world(spec, model, options))
    cell.executor.hold(0.5)
    verdict = cell.check(contract or {})
    if isinstance(verdict, Rejected):
        return ReplayTry("refused", None, verdict.hint)
    before, q_before, held = cell.executor.scene, cell.executor.state.q.copy(), cell.executor.held_object
    outcome = cell.executor.execute(verdict.contract)
    evidence = collect_evidence(
        before, cell.executor.scene, verdict.contract, outcome, q_before, cell.executor.state.q, model, held=held
    )
    check = check_outcome(stored.episode.instruction, outcome, verdict.contract, evidence).check
    disputed = outcome.kind == "succeeded" and check == "disagrees"  # memory does not take it as a success
    return ReplayTry("disputed" if disputed else outcome.kind, outcome.Delta, outcome.reason)


def make_replay_evaluator(
    ledger: LedgerReader, samples: Sequence[Sample], *, seed: int
) -> Callable[[Sample, str], tuple[bool, float | None]]:
    """A function (sample, contract) → (success by the robot's own verdict, Δ) of a run in the scene of the sample.

    The world is rebuilt from the perceived scene (`simulation.scenes.from_memory`); the same seed gives every planner
    the same world. Raises `ConfigurationError`, before any run, if one of `samples` is of another ledger, or of a
    memory whose robot or scene cannot be simulated.
    """
    state = derive_state(ledger)
    if unknown := [sample.memory for sample in samples if sample.memory not in state]:
        raise ConfigurationError.stating(
            f"The memory {unknown[0]} of a sample is not in this ledger.",
            fix="Name the ledger of the data set with --ledger, or do not execute the contracts (--no-fly).",
        )
    for name in dict.fromkeys(sample.memory for sample in samples):
        _check_world(ledger, state[name])

    def evaluate(sample: Sample, text: str) -> tuple[bool, float | None]:
        result = run_alternative(ledger, state[sample.memory], msgspec.json.decode(text), seed=seed)
        return result.succeeded, result.Delta

    return evaluate


def _check_world(ledger: LedgerReader, memory: MemoryState) -> None:
    """Raise `ConfigurationError` if robot or scene of `memory` cannot be simulated."""
    try:
        load_builtin_robot(memory.robot)
        stored = msgspec.json.decode(ledger.event(memory.seq).payload, type=_StoredPayload)
        scene_from_memory(stored.episode.scene, np.random.default_rng(0), position_spread=POSITION_SPREAD)
    except DualbrainError as error:
        raise ConfigurationError.stating(
            f"The world of memory {memory.id} cannot be simulated: {error}",
            fix="Do not execute the contracts (--no-fly), or leave the memory out of the data set "
            "(`dualbrain memory quarantine`).",
        ) from error
