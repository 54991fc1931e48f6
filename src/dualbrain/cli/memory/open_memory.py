"""Opening memory for a command: which ledger, for reading or writing, with the encoder and the bodies it speaks of."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from dualbrain.cli.common.console import answer
from dualbrain.cli.common.paths import cache, home
from dualbrain.errors import UnknownName

if TYPE_CHECKING:
    from dualbrain.memory.config import MemoryConfig
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.memory.ledger.ledger import LedgerReader
    from dualbrain.memory.memory import Memory

PATIENCE = 5.0
"""How long a command waits for a run that is writing [s]."""


def ledger_path(chosen: Path | None) -> Path:
    """The ledger named on the command line, else the one in dualbrain's home."""
    return chosen or home() / "ledger.sqlite"


@contextmanager
def reader(chosen: Path | None) -> Generator[LedgerReader]:
    """The ledger, for reading; also while a run writes."""
    from dualbrain.memory.ledger.ledger import LedgerReader

    with LedgerReader(ledger_path(chosen)) as ledger:
        yield ledger


@contextmanager
def memory(chosen: Path | None, *, writing: str = "") -> Generator[Memory]:
    """The whole memory; `writing` names the command that is about to change it."""
    from dualbrain.memory.memory import Memory

    with _ledger(chosen, writing) as ledger:
        yield Memory(ledger, encoder(), config(ledger))


@contextmanager
def _ledger(chosen: Path | None, writing: str) -> Generator[LedgerReader]:
    from dualbrain.memory.ledger.ledger import Ledger, LedgerReader

    path = ledger_path(chosen)
    LedgerReader(path).close()  # a command never makes a ledger
    if not writing:
        with LedgerReader(path) as ledger:
            yield ledger
        return
    with Ledger(path, holder=f"dualbrain memory {writing}", now=time.time(), patience=PATIENCE) as ledger:
        yield ledger


def encoder() -> Any:
    """The sentence encoder."""
    from dualbrain.memory.embedding.text_encoder import MiniLmEncoder

    return MiniLmEncoder.fetched(cache())


def config(ledger: LedgerReader) -> MemoryConfig:
    """The default dials, with the limits of every robot in the ledger that this program knows."""
    from dualbrain.memory.config import MemoryConfig

    robots = {row.episode.robot for row in _heads(ledger)}
    return MemoryConfig(tuple(limits for robot in sorted(robots) for limits in limits_of(robot)))


def limits_of(robot: str) -> tuple[PostureLimits, ...]:
    """The limits of `robot`, none if this program does not know it."""
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.robots.loader import load_body

    try:
        return (PostureLimits.of(load_body(robot)),)
    except UnknownName:
        return ()


def _heads(ledger: LedgerReader) -> list[Any]:
    from dualbrain.memory.state.episode_record import read_memo

    return [read_memo(event.payload) for event in ledger.events("kind = 'episode'")]


def tell(value: object) -> None:
    """Print one JSON object on stdout."""
    answer(msgspec.json.encode(value).decode())
