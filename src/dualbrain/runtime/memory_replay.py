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
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.errors import InvalidSetup
from dualbrain.grounding.outcome_check import second_opinion
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import grants, scene_names, vocabulary
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.events import ReplayFinding
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.maintenance.contradiction import chance, contradicted
from dualbrain.memory.state.derivation import derive
from dualbrain.memory.state.state import Memo
from dualbrain.records import Outcome, Scene
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.scenes.from_memory import remembered_scene
from dualbrain.simulation.world import SimulatedWorld

SPREAD = 0.003
"""Standard deviation of the shifts of things between tries [m]: that of perception."""
APART, FLOOR = 3.0, 1e-3
"""Δ contradicts if it differs more than threefold, both counted as at least the floor."""


class _Body(msgspec.Struct):
    scene: Scene
    contract: dict[str, Any] | None


class _Stored(msgspec.Struct):
    episode: _Body
    state: Posture


@dataclass(frozen=True, slots=True)
class Try:
    """One run: how it ended by the robot's own verdict (or "refused" by the gate), and Δ."""

    kind: str
    Delta: float | None
    reason: str

    @property
    def succeeded(self) -> bool:
        """Whether the robot's own senses call it a success."""
        return self.kind == "succeeded"


def rerun(ledger: LedgerReader, memo: Memo, *, tries: int, seed: int, actor: str) -> ReplayFinding:
    """Run the contract of `memo` `tries` times and compare outcome and Δ with what is remembered.

    Raises `InvalidSetup` for a memory without a contract, or whose scene cannot be simulated.
    """
    stored = msgspec.json.decode(ledger.event(memo.seq).payload, type=_Stored)
    if not stored.episode.contract or memo.Delta is None:
        raise InvalidSetup("memory to replay", got=memo.kind, allowed="one whose contract was carried out", fix=memo.id)
    contract = stored.episode.contract
    done = [_once(stored, contract, memo.robot, np.random.default_rng([seed, number])) for number in range(tries)]
    reason, agrees = verdict(memo.r, memo.Delta, done)
    kinds, Deltas = tuple(one.kind for one in done), tuple(one.Delta for one in done)
    return ReplayFinding(memo.id, agrees, memo.kind, kinds, Deltas, reason, actor)


def verdict(r: int, Delta: float, done: list[Try]) -> tuple[str, bool]:
    """What the tries say of a memory with label `r` and `Delta`, in words, and whether they leave it standing.

    Contradicted if too few agree (see `doubt`), or if Δ of those that do is more than three times larger or smaller.
    """
    agreeing = [one for one in done if one.succeeded == bool(r)]
    told = f"{len(agreeing)} of {len(done)} tries ended as remembered"
    if contradicted(len(agreeing), len(done)):
        would = chance(len(agreeing), len(done))
        return f"{told}: too few (a true memory would show that with chance {would:.3f})", False
    found = [one.Delta for one in agreeing if one.Delta is not None]
    if r and found:
        middle, remembered = max(median(found), FLOOR), max(Delta, FLOOR)
        if not 1.0 / APART <= middle / remembered <= APART:
            return f"{told}, but with Δ {middle:.4f} where {Delta:.4f} is remembered", False
    return told, True


def run_instead(ledger: LedgerReader, memo: Memo, contract: dict[str, Any], *, seed: int) -> Try:
    """What becomes of another `contract` in the world of `memo`, once; raises `InvalidSetup` if that cannot be."""
    stored = msgspec.json.decode(ledger.event(memo.seq).payload, type=_Stored)
    return _once(stored, contract, memo.robot, np.random.default_rng([seed, memo.seq]))


def _once(stored: _Stored, contract: dict[str, Any] | None, robot: str, rng: np.random.Generator) -> Try:
    body = load_body(robot)
    spec = remembered_scene(stored.episode.scene, rng, spread=SPREAD)
    plant = open_plant(spec, body, visuals=False)
    plant.place_arm(np.asarray(stored.state.q), stored.state.opening)
    world = SimulatedWorld(plant, Perception(spec, Noise(), rng))
    layer = LocalLayer(
        body,
        plant,
        world,
        SafetyFilter(body),
        FlightLog(Trace(body.n, body.width)),
        LayerConfig(),
        phase_changed=world.allow,
    )
    layer.hold(0.5)
    accepted = _accepted(layer, body, contract)
    if isinstance(accepted, Rejected):
        return Try("refused", None, accepted.hint)
    outcome = layer.run(accepted)
    return Try(_kind(layer, accepted, outcome), outcome.Delta, outcome.reason)


def _kind(layer: LocalLayer, contract: Contract, outcome: Outcome) -> str:
    """The outcome as memory would have it: a success that the eyes dispute is none."""
    disputed = outcome.kind == "succeeded" and second_opinion(layer.scene, contract, outcome) == "disagrees"
    return "disputed" if disputed else outcome.kind


def _accepted(layer: LocalLayer, body: Body, contract: dict[str, Any] | None) -> Contract | Rejected:
    """The contract through today's gate: a memory that no longer passes it is no memory to follow."""
    registry = vocabulary(body.name)
    gate = Gate(registry, grants(registry), scene_rules(layer.scene, layer.limb))
    data, names = msgspec.json.encode(contract), scene_names(layer.scene)
    said = gate.check(data, names=names, principal=PLANNER, now=layer.state.stamp)
    return said.contract if isinstance(said, Accepted) else said


def remembered_flight(
    ledger: LedgerReader, asked: Sequence[Sample], *, seed: int
) -> Callable[[Sample, str], tuple[bool, float | None]]:  # fmt: skip
    """Success by the robot's own senses, and Δ, of a contract in the scene that one of `asked` was made of.

    The world is rebuilt from what was perceived (see `world.remembered`); the same seed gives every planner the same
    world. Raises `InvalidSetup`, before anything is flown, if one of `asked` is of another ledger.
    """
    state = derive(ledger)
    if strange := [sample.memory for sample in asked if sample.memory not in state]:
        fix = "Name the ledger that the data set was made of with --ledger; what no ledger made is asked with --no-fly."
        raise InvalidSetup("memory of a question", got=strange[0], allowed="one of this ledger", fix=fix)

    def fly(sample: Sample, text: str) -> tuple[bool, float | None]:
        done = run_instead(ledger, state[sample.memory], msgspec.json.decode(text), seed=seed)
        return done.succeeded, done.Delta

    return fly
