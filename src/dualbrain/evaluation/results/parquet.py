"""Results as Parquet: one row per episode, the complete configuration in the file's metadata."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any, get_args, get_origin

import msgspec

from dualbrain.core.storage.atomic_files import atomic_file
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.evaluation.results.episode_row import EpisodeRow

RESULTS_FILE = "results.parquet"
CONFIG_METADATA_KEY = b"dualbrain.config"
COMPRESSION = "zstd(3)"
PARQUET_MAGIC, MIN_FILE_BYTES = b"PAR1", 12
INSTALL_HINT = "Install it with `pip install 'dualbrain[evaluation]'`."


def write_results(rows: Sequence[EpisodeRow], config: dict[str, Any], path: Path) -> None:
    """Write `rows` and `config` to `path` atomically; structured fields (violations, answers) become JSON text.

    The umask determines the file's permissions. Raises `FileWriteError` if the file cannot be written,
    `MissingDependencyError` without the Parquet package.
    """
    core, io = _import_arrow()
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


def read_results(path: Path) -> tuple[list[EpisodeRow], dict[str, Any]]:
    """Rows and configuration of the file at `path`.

    Raises `ConfigurationError` for a file that `write_results` did not write, `MissingDependencyError` without the
    Parquet package.
    """
    _, io = _import_arrow()
    _check_magic(path)
    try:
        table = io.read_parquet(str(path)).read_all()
        config = msgspec.json.decode(dict(table.schema.metadata)[CONFIG_METADATA_KEY])
        fields = [(one.name, one.type) for one in msgspec.structs.fields(EpisodeRow)]
        columns = [[_decode_cell(kind, cell.as_py()) for cell in table[name]] for name, kind in fields]
    except Exception as error:
        sentence = f"The results cannot be read ({type(error).__name__}: {error})"[:200] + "."
        raise ConfigurationError.stating(
            sentence, fix=f"Name a results.parquet of `dualbrain evaluate`. {path}"
        ) from error
    names = [name for name, _ in fields]
    return [
        msgspec.convert(dict(zip(names, cells, strict=True)), EpisodeRow) for cells in zip(*columns, strict=True)
    ], config


def _check_magic(path: Path) -> None:
    """Raise `ConfigurationError` unless the file begins and ends as Parquet does; otherwise the reader would panic."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4)
        file.seek(max(0, size - 4))
        complete = size >= MIN_FILE_BYTES and head == file.read(4) == PARQUET_MAGIC
    if not complete:
        sentence = f"The results file ({size} bytes) is no complete Parquet file."
        raise ConfigurationError.stating(sentence, fix=f"Restore a copy, or run `dualbrain evaluate` again. {path}")


def require_parquet() -> None:
    """Raise `MissingDependencyError` without the package that reads and writes Parquet files."""
    _import_arrow()


def _import_arrow() -> tuple[Any, Any]:
    try:
        from arro3 import core, io  # noqa: PLC0415  (an extra; imported when a table is written or read)
    except ModuleNotFoundError as error:
        raise MissingDependencyError("The package arro3-io, of the extra `evaluation`,", fix=INSTALL_HINT) from error
    return core, io


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
