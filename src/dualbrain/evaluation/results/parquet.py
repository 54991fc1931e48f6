"""Results as Parquet: one row per episode, the complete configuration in the file's metadata."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any, get_args, get_origin

import msgspec

from dualbrain.core.storage.arrow_package import import_arrow
from dualbrain.core.storage.atomic_files import atomic_file
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_bounded_file, read_regular_file
from dualbrain.core.untrusted.bounded_process import ProcessFailure, ProcessLimits, stream_bounded
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.evaluation.results.episode_row import EpisodeRow

RESULTS_FILE = "results.parquet"
CONFIG_METADATA_KEY = b"dualbrain.config"
COMPRESSION = "zstd(3)"
PARQUET_MAGIC, MIN_FILE_BYTES = b"PAR1", 12
MAX_FILE_BYTES = 128 << 20
"""Largest size of a results file [bytes]: a thousand times that of the largest evaluation so far."""
ROWS_AT_A_TIME = 64
READING_LIMITS = ProcessLimits(output_bytes=2 << 30)


def write_results(rows: Sequence[EpisodeRow], config: dict[str, Any], path: Path) -> None:
    """Write `rows` and `config` to `path` atomically; structured fields (violations, answers) become JSON text.

    The umask determines the file's permissions. Raises `FileWriteError` if the file cannot be written,
    `MissingDependencyError` without the Parquet package.
    """
    core, io = import_arrow()
    fields = msgspec.structs.fields(EpisodeRow)
    columns = [_column(core, one.type, [getattr(row, one.name) for row in rows]) for one in fields]
    heads = [core.Field(one.name, column.type, nullable=True) for one, column in zip(fields, columns, strict=True)]
    schema = core.Schema(heads, metadata={CONFIG_METADATA_KEY: msgspec.json.encode(config)})
    table = core.Table.from_batches([core.RecordBatch.from_arrays(columns, schema=schema)])
    buffer = BytesIO()  # in memory, because the Parquet writer panics if the disk is full
    io.write_parquet(table, buffer, compression=COMPRESSION)
    with atomic_file(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def without_trace(row: EpisodeRow) -> EpisodeRow:
    """`row` without h and δ over time, which are most of its bytes."""
    return msgspec.structs.replace(row, trace_t=[], trace_h=[], trace_delta=[])


def read_results(path: Path, limits: ProcessLimits = READING_LIMITS) -> tuple[list[EpisodeRow], dict[str, Any]]:
    """Rows and configuration of the file at `path`, which is read in a process within `limits`.

    Raises `ConfigurationError` for a file that `write_results` did not write, or that exceeds the limits,
    `MissingDependencyError` without the Parquet package.
    """
    require_parquet()
    if isinstance(refusal := read_regular_file(path, 0), FileRefusal) and refusal.kind != "too large":
        raise ConfigurationError.stating(refusal.sentence, fix="Name a results.parquet of `dualbrain evaluate`.")
    argument = msgspec.msgpack.encode((str(path.resolve()), MAX_FILE_BYTES, str(path)))
    config: dict[str, Any] | None = None
    rows: list[EpisodeRow] = []
    for found in stream_bounded("dualbrain.evaluation.results.parquet:decode_results", argument, limits):
        if isinstance(found, ProcessFailure):
            raise _unreadable(path, f"The results file {found.reason}.")
        try:
            if config is None:
                config = msgspec.msgpack.decode(found, type=dict[str, Any])
            else:
                rows += msgspec.msgpack.decode(found, type=list[EpisodeRow])
        except DECODE_ERRORS as error:
            raise _unreadable(path, f"The results cannot be read ({error}).") from error
    return rows, config or {}


def decode_results(argument: bytes) -> Iterator[bytes]:
    """The configuration, then batches of rows; runs in the process that `read_results` starts.

    A column that the file lacks, because it is older than the column, takes the default of its field.
    The argument is an encoded triple: the path, the largest size of the file [bytes], and the name for messages.
    """
    name, limit, shown = msgspec.msgpack.decode(argument, type=tuple[str, int, str])
    data = read_bounded_file(Path(name), limit)
    _check_magic(data, Path(shown))
    _, io = import_arrow()
    try:
        reader = io.read_parquet(BytesIO(data))
        fields = _fields_in(set(reader.schema.names))
        names = [name for name, _ in fields]
        yield msgspec.msgpack.encode(msgspec.json.decode(dict(reader.schema.metadata)[CONFIG_METADATA_KEY]))
        for batch in reader:
            for start in range(0, batch.num_rows, ROWS_AT_A_TIME):
                part = batch.slice(start, min(ROWS_AT_A_TIME, batch.num_rows - start))
                columns = [[_decode_cell(kind, cell.as_py()) for cell in part[name]] for name, kind in fields]
                rows = zip(*columns, strict=True)
                yield msgspec.msgpack.encode([dict(zip(names, cells, strict=True)) for cells in rows])
    except (ConfigurationError, MemoryError, RecursionError):
        raise
    except BaseException as error:  # a panic of the reader is no `Exception`
        text = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise _unreadable(Path(shown), f"The results cannot be read ({text}).") from error


def _fields_in(written: set[str]) -> list[tuple[str, Any]]:
    """Name and type of the fields to read: results of an earlier version lack fields that have a default value."""
    fields = msgspec.structs.fields(EpisodeRow)
    return [(one.name, one.type) for one in fields if one.required or one.name in written]


def _unreadable(path: Path, sentence: str) -> ConfigurationError:
    return ConfigurationError.stating(sentence, fix=f"Name a results.parquet of `dualbrain evaluate`. {path}")


def _check_magic(data: bytes, path: Path) -> None:
    """Raise `ConfigurationError` unless the file begins and ends as Parquet does."""
    if len(data) < MIN_FILE_BYTES or not data[:4] == data[-4:] == PARQUET_MAGIC:
        sentence = f"The results file ({len(data)} bytes) is no complete Parquet file."
        raise ConfigurationError.stating(sentence, fix=f"Restore a copy, or run `dualbrain evaluate` again. {path}")


def require_parquet() -> None:
    """Raise `MissingDependencyError` without the package that reads and writes Parquet files."""
    import_arrow()


def _column(core: Any, kind: Any, values: list[Any]) -> Any:
    """One column in the narrowest type that holds its field."""
    scalars: dict[Any, Callable[[], Any]] = {
        str: core.DataType.utf8,
        int: core.DataType.int64,
        float: core.DataType.float64,
        bool: core.DataType.bool,
    }
    scalar = _non_optional_type(kind)
    if scalar in scalars:
        return core.Array(values, type=scalars[scalar]())
    if kind == list[float]:
        ends = list(accumulate((len(one) for one in values), initial=0))
        flat = core.Array([value for one in values for value in one], type=core.DataType.float64())
        return core.list_array(core.Array(ends, type=core.DataType.int32()), flat)
    texts = [msgspec.json.encode(value).decode() for value in values]
    return core.Array(texts, type=core.DataType.utf8())


def _decode_cell(kind: Any, cell: Any) -> Any:
    return (
        cell
        if _non_optional_type(kind) in (str, int, float, bool) or kind == list[float]
        else msgspec.json.decode(cell)
    )


def _non_optional_type(kind: Any) -> Any:
    """`X` of `X | None`."""
    parts = [part for part in get_args(kind) if part is not type(None)]
    return parts[0] if get_origin(kind) is not list and len(parts) == 1 and len(get_args(kind)) == 2 else kind
