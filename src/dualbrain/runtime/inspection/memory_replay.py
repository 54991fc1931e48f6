"""Anomalous replay (paper section 8): a remembered contract run again in simulation, through gate and filter.

Playing the past would prove nothing; the contract is carried out anew, several times, in worlds rebuilt from what was
perceived then. What counts is the robot's own verdict with its second opinion, as it did then: simulator truth takes no
part in what memory believes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import msgspec
import numpy as np

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.outcome_check import check_outcome
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.events import ReplayFinding
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.maintenance.contradiction import agreement_p_value, is_contradicted
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.state import MemoryState
from dualbrain.records import Outcome, Scene
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import CellOptions, SimulatedCell, open_world
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.scenes.from_memory import scene_from_memory

POSITION_SPREAD = 0.003
"""Standard deviation of the shifts of things between tries [m]: that of perception."""
MAX_DELTA_RATIO, MIN_DELTA = 3.0, 1e-3
"""Δ contradicts if it differs more than threefold, both counted as at least the floor."""


class _EpisodePayload(msgspec.Struct):
    scene: Scene
    contract: dict[str, Any] | None


class _StoredPayload(msgspec.Struct):
    episode: _EpisodePayload
    state: Posture


@dataclass(frozen=True, slots=True)
class ReplayTry:
    """One run: how it ended by the robot's own verdict (or "refused" by the gate), and Δ."""

    kind: str
    Delta: float | None
    reason: str

    @property
    def succeeded(self) -> bool:
        """Whether the robot's own senses call it a success."""
        return self.kind == "succeeded"


def replay_memory(ledger: LedgerReader, memory: MemoryState, *, tries: int, seed: int, actor: str) -> ReplayFinding:
    """Run the contract of `memo` `tries` times and compare outcome and Δ with what is remembered.

    Raises `InvalidSetup` for a memory without a contract, or whose scene cannot be simulated.
    """
    stored = msgspec.json.decode(ledger.event(memory.seq).payload, type=_StoredPayload)
    if not stored.episode.contract or memory.Delta is None:
        raise ConfigurationError(
            "memory to replay", got=memory.kind, allowed="one whose contract was carried out", fix=memory.id
        )
    contract = stored.episode.contract
    done = [_run_once(stored, contract, memory.robot, np.random.default_rng([seed, number])) for number in range(tries)]
    reason, agrees = compare_with_memory(memory.r, memory.Delta, done)
    kinds, Deltas = tuple(one.kind for one in done), tuple(one.Delta for one in done)
    return ReplayFinding(
        memory=memory.id,
        agrees=agrees,
        remembered=memory.kind,
        outcomes=kinds,
        Deltas=Deltas,
        reason=reason,
        actor=actor,
    )


def compare_with_memory(r: int, Delta: float, done: list[ReplayTry]) -> tuple[str, bool]:
    """What the tries say of a memory with label `r` and `Delta`, in words, and whether they leave it standing.

    Contradicted if too few agree (see `doubt`), or if Δ of those that do is more than three times larger or smaller.
    """
    agreeing = [one for one in done if one.succeeded == bool(r)]
    told = f"{len(agreeing)} of {len(done)} tries ended as remembered"
    if is_contradicted(len(agreeing), len(done)):
        would = agreement_p_value(len(agreeing), len(done))
        return f"{told}: too few (a true memory would show that with chance {would:.3f})", False
    found = [one.Delta for one in agreeing if one.Delta is not None]
    if r and found:
        middle, remembered = max(median(found), MIN_DELTA), max(Delta, MIN_DELTA)
        if not 1.0 / MAX_DELTA_RATIO <= middle / remembered <= MAX_DELTA_RATIO:
            return f"{told}, but with Δ {middle:.4f} where {Delta:.4f} is remembered", False
    return told, True


def run_alternative(ledger: LedgerReader, memory: MemoryState, contract: dict[str, Any], *, seed: int) -> ReplayTry:
    """What becomes of another `contract` in the world of `memo`, once; raises `InvalidSetup` if that cannot be."""
    stored = msgspec.json.decode(ledger.event(memory.seq).payload, type=_StoredPayload)
    return _run_once(stored, contract, memory.robot, np.random.default_rng([seed, memory.seq]))


def _run_once(
    stored: _StoredPayload, contract: dict[str, Any] | None, robot: str, rng: np.random.Generator
) -> ReplayTry:
    model = load_robot(robot)
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
    outcome = cell.executor.execute(verdict.contract)
    return ReplayTry(_outcome_kind(cell.executor.scene, verdict.contract, outcome), outcome.Delta, outcome.reason)


def _outcome_kind(scene: Scene, contract: Contract, outcome: Outcome) -> str:
    """The outcome as memory would store it: a success that the outcome check disputes does not count as one."""
    disputed = outcome.kind == "succeeded" and check_outcome(scene, contract, outcome) == "disagrees"
    return "disputed" if disputed else outcome.kind


def make_replay_evaluator(
    ledger: LedgerReader, samples: Sequence[Sample], *, seed: int
) -> Callable[[Sample, str], tuple[bool, float | None]]:
    """Success by the robot's own senses, and Δ, of a contract in the scene that one of `asked` was made of.

    The world is rebuilt from what was perceived (see `world.remembered`); the same seed gives every planner the same
    world. Raises `InvalidSetup`, before anything is flown, if one of `asked` is of another ledger.
    """
    state = derive_state(ledger)
    if strange := [sample.memory for sample in samples if sample.memory not in state]:
        fix = "Name the ledger that the data set was made of with --ledger; what no ledger made is asked with --no-fly."
        raise ConfigurationError("memory of a question", got=strange[0], allowed="one of this ledger", fix=fix)

    def fly(sample: Sample, text: str) -> tuple[bool, float | None]:
        done = run_alternative(ledger, state[sample.memory], msgspec.json.decode(text), seed=seed)
        return done.succeeded, done.Delta

    return fly
