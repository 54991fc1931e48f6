"""Open the memory for a command: the ledger for reading or writing, the encoder, and the limits of its robots."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from rich.markup import escape

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.errors import UnknownNameError

if TYPE_CHECKING:
    from dualbrain.memory.config import MemoryConfig
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.memory.ledger.ledger import LedgerReader
    from dualbrain.memory.memory import Memory

RUN_FOLDERS = (Path("runs"),)
"""Folders of runs whose anchors are compared with the ledger, besides those that the ledger records."""
LOCK_TIMEOUT_S = 5.0
"""Time that a command waits for another writer of the ledger [s]."""


def ledger_path(chosen: Path | None) -> Path:
    """The ledger given on the command line, else the default one in the data folder."""
    return chosen or dualbrain_home() / "ledger.sqlite"


@contextmanager
def open_reader(chosen: Path | None, *, warn: bool = True) -> Generator[LedgerReader]:
    """The ledger, read only; this works while a run writes. With `warn`, faults of its anchors are printed."""
    from dualbrain.memory.ledger.ledger import LedgerReader

    with LedgerReader(ledger_path(chosen)) as ledger:
        if warn:
            warn_about_anchors(ledger)
        yield ledger


def warn_about_anchors(ledger: LedgerReader) -> None:
    """Print a warning for each event that the ledger had contained and lacks now."""
    from dualbrain.memory.ledger.anchors import check_anchors

    for fault in check_anchors(ledger, RUN_FOLDERS).faults:
        StderrConsole().print(f"[yellow]{escape(fault.sentence)} See `dualbrain memory verify`.[/]")


@contextmanager
def open_memory(chosen: Path | None, *, writing: str = "") -> Generator[Memory]:
    """The memory; `writing` is the name of the command that will change it, "" for read only."""
    from dualbrain.memory.memory import Memory

    with _open_ledger(chosen, writing) as ledger:
        known = len(ledger.notices)
        memory = Memory(ledger, load_encoder(), memory_config(ledger))
        for notice in ledger.notices[known:]:
            StderrConsole().print(f"[yellow]{escape(notice)}[/]")
        yield memory


@contextmanager
def _open_ledger(chosen: Path | None, writing: str) -> Generator[LedgerReader]:
    from dualbrain.memory.ledger.ledger import Ledger, LedgerReader

    path = ledger_path(chosen)
    LedgerReader(path).close()  # a command never creates a ledger
    if not writing:
        with LedgerReader(path) as ledger:
            warn_about_anchors(ledger)
            yield ledger
        return
    holder = f"dualbrain memory {writing}"
    with Ledger(path, holder=holder, now=time.time(), timeout_s=LOCK_TIMEOUT_S, run_folders=RUN_FOLDERS) as ledger:
        for notice in ledger.notices:
            StderrConsole().print(f"[yellow]{escape(notice)}[/]")
        yield ledger


def load_encoder() -> Any:
    """The sentence encoder."""
    from dualbrain.memory.embedding.text_encoder import MiniLmEncoder

    return MiniLmEncoder.from_cache(cache_folder())


def memory_config(ledger: LedgerReader) -> MemoryConfig:
    """The default configuration, with the joint limits of every known robot in the ledger."""
    from dualbrain.memory.config import MemoryConfig

    robots = {row.episode.robot for row in _read_headers(ledger)}
    return MemoryConfig(limits=tuple(limits for robot in sorted(robots) for limits in posture_limits(robot)))


def posture_limits(robot: str) -> tuple[PostureLimits, ...]:
    """The joint limits of `robot`; empty if the robot is unknown."""
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.robots.loader import load_robot

    try:
        return (PostureLimits.from_model(load_robot(robot)),)
    except UnknownNameError:
        return ()


def _read_headers(ledger: LedgerReader) -> list[Any]:
    from dualbrain.memory.ledger.events import EPISODE
    from dualbrain.memory.state.episode_record import decode_event_header

    return [decode_event_header(event.payload) for event in ledger.events(EPISODE)]


def print_json(value: object) -> None:
    """Print one JSON object on stdout."""
    print_result(msgspec.json.encode(value).decode())
