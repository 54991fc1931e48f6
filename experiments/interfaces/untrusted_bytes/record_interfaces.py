"""Recordings, tables of results, ledgers and their anchors. Readers run in this process, with the product's handling.

The product reads recordings and tables in a process of its own; here the same function runs in this process, and
an exception of it becomes the failure that the process would report.
"""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_origin
from unittest.mock import patch

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

from dualbrain.control.recording import channels
from dualbrain.control.recording.channels import FORMAT, read_recording, read_trace, recording_state
from dualbrain.control.recording.trace import columns
from dualbrain.core.untrusted.bounded_process import ProcessFailure, ProcessLimits
from dualbrain.errors import DualbrainError
from dualbrain.evaluation.results import parquet
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.maintenance.verification import verify
from experiments.interfaces.untrusted_bytes.interface import ByteInterface, refuse_if
from experiments.interfaces.untrusted_bytes.mutation import BYTE_KINDS, JSON, VALID, mutate_bytes, mutate_text

N_JOINTS, NOW = 7, 1.8e9
DAMAGED = frozenset({"compressed", "no bytes"})
LEDGER_SHARE = 0.05
STATE = '{"complete": true, "dropped": 0, "problem": ""}'


def stream_in_process(function: str, argument: bytes, limits: ProcessLimits) -> Iterator[bytes | ProcessFailure]:
    """As `stream_bounded`, without a process and its limits."""
    del limits
    module, _, name = function.partition(":")
    try:
        yield from getattr(import_module(module), name)(argument)
    except DualbrainError:
        raise
    except (Exception, MemoryError) as error:  # the process would report it
        yield ProcessFailure("exception", f"raised {type(error).__name__}")


def record_interfaces(folder: Path) -> dict[str, ByteInterface]:
    """Interfaces by name; their files are written to `folder`."""
    return {
        "recording": _recording(folder / "ticks.mcap"),
        "table of results": _table(folder / "results.parquet"),
        "ledger": _ledger(folder / "ledger.db"),
        "anchor of a ledger": _anchor(folder / "anchored.db"),
    }


# --- recordings -----------------------------------------------------------------------------------------------------


def _recording(path: Path) -> ByteInterface:
    widths = {name: place.stop - place.start for name, place in columns(N_JOINTS).items()}
    ticks = {
        "t": 0.0,
        "n": N_JOINTS,
        "phases": [],
        "columns": {k: np.zeros((2, w)).tolist() for k, w in widths.items()},
    }
    messages = {
        "/episode": msgspec.json.encode({"t": 0.0, "data": {"robot": "panda", "guard": True}}),
        "/tick": msgspec.json.encode(ticks),
    }
    small = [name for name in messages if len(messages[name]) < 200]

    def mutate(kind: str, rng: np.random.Generator) -> bytes | None:
        if kind in (VALID, *BYTE_KINDS):
            return mutate_bytes(kind, _mcap(messages), rng)
        name = small[0] if rng.random() < 0.3 else "/tick"
        changed = mutate_text(kind, messages[name], JSON, rng)
        return None if changed is None else _mcap(messages | {name: changed})

    def read(data: bytes) -> None:
        path.write_bytes(data)
        with patch.object(channels, "stream_bounded", stream_in_process):
            list(read_recording(path))
            trace = read_trace(path)
            state = recording_state(path)
        refuse_if(trace is None, "no ticks")
        refuse_if(not state.complete and b"dualbrain" not in data, state.problem)

    return ByteInterface(mutate=mutate, read=read, refuses=DAMAGED, share=0.2)


def _mcap(messages: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(FORMAT)
    schema = writer.register_schema("any", "jsonschema", b"{}")
    for topic, data in messages.items():
        writer.add_message(writer.register_channel(topic, "json", schema), 0, data, 0)
    writer.add_metadata("dualbrain", {"format": FORMAT, "state": STATE})
    writer.finish()
    return buffer.getvalue()


# --- tables of results ----------------------------------------------------------------------------------------------


def _table(path: Path) -> ByteInterface:
    row = _result_row()
    texts = [field.name for field in msgspec.structs.fields(EpisodeRow) if field.type is str]
    parquet.write_results([row], {"suite": "tiny"}, path)
    valid = path.read_bytes()

    def mutate(kind: str, rng: np.random.Generator) -> bytes | None:
        if kind in (VALID, *BYTE_KINDS):
            return mutate_bytes(kind, valid, rng)
        data = bytearray(valid)
        if kind in ("unicode", "long", "deep", "empty"):
            value = {"unicode": "\u202e\x00", "long": "x" * 100_000, "deep": "[" * 30_000, "empty": ""}[kind]
            changed = msgspec.structs.replace(row, **{texts[int(rng.integers(len(texts)))]: value})
            parquet.write_results([changed], {"suite": value}, path)
            return path.read_bytes()
        for _ in range(int(rng.integers(1, 6))):  # numbers of the format itself: lengths, offsets, types
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        return bytes(data)

    def read(data: bytes) -> None:
        path.write_bytes(data)  # in a process: the Parquet library ends its process on some damaged files
        rows, _ = parquet.read_results(path)
        refuse_if(len(rows) > 10_000, "too many rows")

    return ByteInterface(
        mutate=mutate, read=read, refuses=frozenset({"truncated", "compressed", "no bytes"}), share=0.1
    )


def _result_row() -> EpisodeRow:
    """A row with a value of its type in every field."""
    samples: dict[Any, Any] = {str: "a", int: 1, float: 0.5, bool: True, type(None): None}
    values: dict[str, Any] = {}
    for field in msgspec.structs.fields(EpisodeRow):
        if field.required:
            kinds = (field.type, *(() if get_origin(field.type) in (list, dict, tuple) else get_args(field.type)))
            values[field.name] = next((samples[kind] for kind in kinds if kind in samples), _empty(field.type))
    return EpisodeRow(**values)


def _empty(kind: Any) -> Any:
    return {} if get_origin(kind) is dict else () if get_origin(kind) is tuple else []


# --- ledgers --------------------------------------------------------------------------------------------------------


def _ledger(path: Path) -> ByteInterface:
    with Ledger(path, holder="an experiment", now=NOW) as ledger:
        for number in range(3):
            note = PendingEvent(kind="note", subject=f"s{number}", payload={"text": "a note", "value": 0.5})
            ledger.append([note], now=NOW + number)
    valid = path.read_bytes()
    columns_of = ("kind", "subject", "time", "payload", "hash")

    def mutate(kind: str, rng: np.random.Generator) -> bytes | None:
        if kind in (VALID, *BYTE_KINDS):
            return mutate_bytes(kind, valid, rng)
        path.write_bytes(valid)
        column = columns_of[int(rng.integers(len(columns_of)))]
        database = sqlite3.connect(path, isolation_level=None)
        ((trigger,),) = database.execute(
            "SELECT sql FROM sqlite_master WHERE name = 'event_is_never_changed'"
        ).fetchall()
        database.execute("DROP TRIGGER event_is_never_changed")
        known = {name for (_, name, *_) in database.execute("PRAGMA table_info(event)")}
        value = _CELLS[kind][int(rng.integers(len(_CELLS[kind])))]
        try:
            if column in known:
                database.execute(f"UPDATE event SET {column} = ? WHERE seq = ?", (value, int(rng.integers(1, 4))))
            changed = database.execute("SELECT changes()").fetchone()[0]
            database.execute(trigger)
        except sqlite3.IntegrityError:
            changed = 0
        finally:
            database.close()
        return path.read_bytes() if changed else None

    def read(data: bytes) -> None:
        for other in path.parent.glob(f"{path.name}-*"):
            other.unlink()
        path.write_bytes(data)
        with LedgerReader(path) as reader:
            found = verify(reader)
        refuse_if(not found.is_intact, found)

    kinds = frozenset(_CELLS) | {"truncated", "compressed"}
    return ByteInterface(mutate=mutate, read=read, refuses=kinds, share=LEDGER_SHARE)


_CELLS: dict[str, tuple[Any, ...]] = {
    "nan": (float("nan"), "nan"),
    "infinite": (float("inf"), float("-inf")),
    "denormal": (5e-324,),
    "negative": (-1, -0.5),
    "huge": (1e300, 2**63 - 1),
    "empty": ("", b""),
    "wrong type": (7, "text", b"bytes", 0.5),
    "wrong shape": ("[]", "[0.1, 0.2]", "{}"),
    "deep": ("[" * 30_000, '{"a":' * 600 + "1" + "}" * 600),
    "long": ("x" * 100_000,),
    "unicode": ("\u202e", "\x00", "\u200b"),
}


def _anchor(path: Path) -> ByteInterface:
    with Ledger(path, holder="an experiment", now=NOW) as ledger:
        ledger.append([PendingEvent(kind="note", subject="s", payload={})], now=NOW)
    anchor = path.with_name(path.name + ".anchor")
    valid, content = path.read_bytes(), anchor.read_bytes()

    def read(data: bytes) -> None:
        for other in path.parent.glob(f"{path.name}-*"):
            other.unlink()
        path.write_bytes(valid)
        anchor.write_bytes(data)
        with LedgerReader(path) as reader:
            found = verify(reader)
        refuse_if(not found.is_intact, found)

    mutate: Callable[..., bytes | None] = lambda kind, rng: mutate_text(kind, content, JSON, rng)  # noqa: E731
    return ByteInterface(
        mutate=mutate, read=read, refuses=DAMAGED | {"nan", "infinite", "deep", "truncated"}, share=LEDGER_SHARE
    )
