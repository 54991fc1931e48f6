"""Opening memory for a command: which ledger, for reading or writing, with the encoder and the bodies it speaks of."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from dualbrain.cli.common.console import print_result
from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.errors import UnknownNameError

if TYPE_CHECKING:
    from dualbrain.memory.config import MemoryConfig
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.memory.ledger.ledger import LedgerReader
    from dualbrain.memory.memory import Memory

LOCK_TIMEOUT_S = 5.0
"""How long a command waits for a run that is writing [s]."""


def ledger_path(chosen: Path | None) -> Path:
    """The ledger named on the command line, else the one in dualbrain's home."""
    return chosen or dualbrain_home() / "ledger.sqlite"


@contextmanager
def open_reader(chosen: Path | None) -> Generator[LedgerReader]:
    """The ledger, for reading; also while a run writes."""
    from dualbrain.memory.ledger.ledger import LedgerReader

    with LedgerReader(ledger_path(chosen)) as ledger:
        yield ledger


@contextmanager
def open_memory(chosen: Path | None, *, writing: str = "") -> Generator[Memory]:
    """The whole memory; `writing` names the command that is about to change it."""
    from dualbrain.memory.memory import Memory

    with _open_ledger(chosen, writing) as ledger:
        yield Memory(ledger, load_encoder(), memory_config(ledger))


@contextmanager
def _open_ledger(chosen: Path | None, writing: str) -> Generator[LedgerReader]:
    from dualbrain.memory.ledger.ledger import Ledger, LedgerReader

    path = ledger_path(chosen)
    LedgerReader(path).close()  # a command never makes a ledger
    if not writing:
        with LedgerReader(path) as ledger:
            yield ledger
        return
    with Ledger(path, holder=f"dualbrain memory {writing}", now=time.time(), timeout_s=LOCK_TIMEOUT_S) as ledger:
        yield ledger


def load_encoder() -> Any:
    """The sentence encoder."""
    from dualbrain.memory.embedding.text_encoder import MiniLmEncoder

    return MiniLmEncoder.from_cache(cache_folder())


def memory_config(ledger: LedgerReader) -> MemoryConfig:
    """The default dials, with the limits of every robot in the ledger that this program knows."""
    from dualbrain.memory.config import MemoryConfig

    robots = {row.episode.robot for row in _read_headers(ledger)}
    return MemoryConfig(limits=tuple(limits for robot in sorted(robots) for limits in posture_limits(robot)))


def posture_limits(robot: str) -> tuple[PostureLimits, ...]:
    """The limits of `robot`, none if this program does not know it."""
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.robots.loader import load_robot

    try:
        return (PostureLimits.from_model(load_robot(robot)),)
    except UnknownNameError:
        return ()


def _read_headers(ledger: LedgerReader) -> list[Any]:
    from dualbrain.memory.state.episode_record import decode_event_header

    return [decode_event_header(event.payload) for event in ledger.events("kind = 'episode'")]


def print_json(value: object) -> None:
    """Print one JSON object on stdout."""
    print_result(msgspec.json.encode(value).decode())
