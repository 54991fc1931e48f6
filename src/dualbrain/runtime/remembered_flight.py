"""Contracts of a planner under measurement, carried out in the worlds that memories were made in (closed loop)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from dualbrain.adaptation.sample import Sample
from dualbrain.errors import InvalidSetup
from dualbrain.memory.derive import derive
from dualbrain.memory.ledger import LedgerReader
from dualbrain.runtime.rerun import run_instead


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
