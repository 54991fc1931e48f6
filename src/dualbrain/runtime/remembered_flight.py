"""Contracts of a planner under measurement, carried out in the worlds that memories were made in (closed loop)."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from dualbrain.adaptation.sample import Sample
from dualbrain.errors import UnknownName
from dualbrain.memory.derive import derive
from dualbrain.memory.ledger import LedgerReader
from dualbrain.runtime.rerun import run_instead


def remembered_flight(ledger: LedgerReader, *, seed: int) -> Callable[[Sample, str], tuple[bool, float | None]]:
    """Success by the robot's own senses, and Δ, of a contract in the scene that a sample was made of.

    The world is rebuilt from what was perceived (see `world.remembered`); the same seed gives every planner the same
    world. Raises `UnknownName` for a sample of another ledger.
    """
    state = derive(ledger)

    def fly(sample: Sample, text: str) -> tuple[bool, float | None]:
        if sample.memory not in state:
            raise UnknownName("memory", sample.memory, (), owner="this ledger: name the one the data set was made of")
        done = run_instead(ledger, state[sample.memory], msgspec.json.decode(text), seed=seed)
        return done.succeeded, done.Delta

    return fly
