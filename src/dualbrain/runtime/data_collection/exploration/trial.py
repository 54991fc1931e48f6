"""One executed alternative: the contract, the world in which it was executed, and the robot's own verdict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

import msgspec

from dualbrain.adaptation.value_model.symbols import Placement
from dualbrain.adaptation.value_model.utility import utility
from dualbrain.adaptation.value_model.value_model import ExecutedSiblings
from dualbrain.contracts.verdict import Accepted
from dualbrain.records import Outcome, OutcomeClass
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.exploration.twin_cell import make_twin_cell

TrialWorld = Literal["twin", "full"]
TIME_LIMIT = 75.0
"""Simulated time [s] after which a trial has failed, that of the slowest task family."""


class Trial(msgspec.Struct, frozen=True, kw_only=True):
    """One alternative at one place with its outcome; `kind` "rejected" is the verdict of the gate.

    `summary` is that of the place with fitting values, `duration` in seconds.
    """

    scene: str
    object_name: str
    destination: str
    summary: str
    alternative: str
    contract: str
    world: TrialWorld
    kind: OutcomeClass
    reason: str = ""
    Delta: float | None = None
    intervention_frequency: float = 0.0
    duration: float = 0.0

    @property
    def utility(self) -> float:
        """U of the outcome."""
        return utility(succeeded=self.kind == "succeeded", Delta=self.Delta, duration=self.duration)


def execute_in_twin(place: Place, alternative: str, contract: str) -> Trial:
    """Execute `contract` in the kinematic twin of `place`."""
    placement = place.placement
    trial = Trial(
        scene=place.scene_name,
        object_name=placement.object_name,
        destination=placement.destination,
        summary=placement.summary,
        alternative=alternative,
        contract=contract,
        world="twin",
        kind="rejected",
    )
    with make_twin_cell(place.spec, time_limit=TIME_LIMIT) as cell:
        verdict = cell.check(contract)
        if not isinstance(verdict, Accepted):
            return msgspec.structs.replace(trial, reason=verdict.hint)
        return with_outcome(trial, cell.execute(verdict.contract))


def with_outcome(trial: Trial, outcome: Outcome) -> Trial:
    """`trial` with the fields of `outcome`."""
    return msgspec.structs.replace(
        trial,
        kind=outcome.kind,
        reason=outcome.reason,
        Delta=outcome.Delta,
        intervention_frequency=outcome.intervention_frequency,
        duration=outcome.duration,
    )


def execute_siblings(place: Place, names: Sequence[str]) -> tuple[Trial, ...]:
    """Execute the alternatives `names` of `place` in the twin."""
    contracts = place.contracts()
    return tuple(execute_in_twin(place, name, contracts[name]) for name in names)


def group_siblings(trials: Iterable[Trial]) -> list[ExecutedSiblings]:
    """The executed alternatives of each place; a contract that the gate rejected has utility 0."""
    by_place: dict[tuple[str, str, str], list[Trial]] = {}
    for one in trials:
        by_place.setdefault((one.scene, one.object_name, one.destination), []).append(one)
    return [
        ExecutedSiblings(
            Placement(some[0].summary, some[0].object_name, some[0].destination),
            {one.alternative: one.utility for one in some},
        )
        for some in by_place.values()
    ]


def encode_trials(trials: Iterable[Trial]) -> bytes:
    """JSON lines, one per trial."""
    return b"".join(msgspec.json.encode(one) + b"\n" for one in trials)


def decode_trials(data: bytes) -> tuple[Trial, ...]:
    """The trials in `data`; raises one of `DECODE_ERRORS` for unreadable lines."""
    return tuple(msgspec.json.decode(line, type=Trial) for line in data.splitlines() if line.strip())
