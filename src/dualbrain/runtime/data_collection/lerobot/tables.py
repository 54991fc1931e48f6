"""The Parquet files of a LeRobotDataset v3, written by arro3: frames, tasks, episodes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.storage.arrow_package import import_arrow
from dualbrain.runtime.data_collection.lerobot.statistics import FeatureStatistics, plain_statistics

COMPRESSION = "snappy"
"""The compression that LeRobot uses; every reader of Parquet has it."""


def write_frames(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write `columns` of K frames, (K,) as scalars and (K, m) as lists of the fixed length m."""
    core, _ = import_arrow()
    _write_table(path, {name: _array(core, values) for name, values in columns.items()})


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the `tasks` in the order of their index.

    The metadata of pandas names the column `task` as the index of the table; without it LeRobot reads numbers as tasks.
    """
    core, _ = import_arrow()
    columns = {"task_index": core.Array.from_numpy(np.arange(len(tasks))), "task": _texts(core, tasks)}
    _write_table(path, columns, metadata={"pandas": json.dumps(_pandas_metadata())})


def write_episodes(path: Path, rows: Sequence[Mapping[str, Any]], statistics: Sequence[Mapping[str, Any]]) -> None:
    """Write one row per episode: integers, the list of texts `tasks`, and `statistics` by feature as lists."""
    core, _ = import_arrow()
    columns: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        columns[name] = _text_lists(core, values) if name == "tasks" else core.Array(values, type=core.DataType.int64())
    columns |= _statistics_columns(core, statistics)
    _write_table(path, columns)


def _statistics_columns(core: Any, episodes: Sequence[Mapping[str, FeatureStatistics]]) -> dict[str, Any]:
    plain = [plain_statistics(episode) for episode in episodes]
    return {
        f"stats/{feature}/{name}": _number_lists(core, [episode[feature][name] for episode in plain])
        for feature, values in plain[0].items()
        for name in values
    }


def _write_table(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
    core, io = import_arrow()
    fields = [core.Field(name, array.type, nullable=True) for name, array in columns.items()]
    schema = core.Schema(fields, metadata=metadata) if metadata else core.Schema(fields)
    batch = core.RecordBatch.from_arrays(list(columns.values()), schema=schema)
    buffer = BytesIO()  # in memory, because the Parquet writer panics if the disk is full
    io.write_parquet(core.Table.from_batches([batch]), buffer, compression=COMPRESSION, skip_arrow_metadata=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(buffer.getvalue())


def _array(core: Any, values: NDArray[Any]) -> Any:
    flat = core.Array.from_numpy(np.ascontiguousarray(values).reshape(-1))
    if values.ndim == 1:
        return flat
    item = core.Field("item", flat.type, nullable=True)
    kind = core.DataType.list(item, values.shape[1])
    return core.fixed_size_list_array(flat, values.shape[1], type=kind)


def _texts(core: Any, values: Sequence[str]) -> Any:
    return core.Array(list(values), type=core.DataType.utf8())


def _text_lists(core: Any, values: Sequence[Sequence[str]]) -> Any:
    return core.list_array(_ends(core, values), _texts(core, [text for one in values for text in one]))


def _number_lists(core: Any, values: Sequence[Sequence[float]]) -> Any:
    numbers = [number for one in values for number in one]
    are_integers = all(isinstance(number, int) for number in numbers)
    kind = core.DataType.int64() if are_integers else core.DataType.float64()
    return core.list_array(_ends(core, values), core.Array(numbers, type=kind))


def _ends(core: Any, values: Sequence[Sequence[Any]]) -> Any:
    return core.Array(list(accumulate(map(len, values), initial=0)), type=core.DataType.int32())


def _pandas_metadata() -> dict[str, Any]:
    def column(name: str, kind: str, stored: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}

    encoding = {"metadata": {"encoding": "UTF-8"}, "name": None, "field_name": None}
    return {
        "index_columns": ["task"],
        "column_indexes": [encoding | {"pandas_type": "unicode", "numpy_type": "object"}],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "pandas_version": "2.3.3",
    }
