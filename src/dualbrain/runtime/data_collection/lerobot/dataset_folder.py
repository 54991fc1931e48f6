"""The folder of a LeRobotDataset v3: frames in files of bounded size, the episodes with their statistics, info.json."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.runtime.data_collection.lerobot.features import Feature
from dualbrain.runtime.data_collection.lerobot.frames import Frames
from dualbrain.runtime.data_collection.lerobot.statistics import (
    FeatureStatistics,
    aggregate_statistics,
    feature_statistics,
    plain_statistics,
)
from dualbrain.runtime.data_collection.lerobot.tables import write_episodes, write_frames, write_tasks

CODEBASE_VERSION = "v3.0"
CHUNK_FILES = 1000
"""Files in one chunk folder."""
MAX_FILE_BYTES = 100 << 20
"""Size of the frames in one data file, uncompressed [bytes]; an episode is never divided."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"

Columns = dict[str, NDArray[Any]]


class DatasetFolder:
    """Writes episodes into `folder`, which is complete after `finish`; the caller makes the whole write atomic."""

    def __init__(self, folder: Path, features: Mapping[str, Feature], fps: int, robot_type: str) -> None:
        """Write the `features` of each frame; `fps` frames are a second."""
        self._folder, self._features, self._fps, self._robot_type = folder, dict(features), fps, robot_type
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._statistics: list[dict[str, FeatureStatistics]] = []
        self._pending: list[Columns] = []
        self._pending_bytes = self._file = self._frames = 0

    def add_episode(self, frames: Frames, task: str) -> None:
        """Add one episode."""
        columns = self._columns(frames, self._tasks.setdefault(task, len(self._tasks)))
        size = sum(values.nbytes for values in columns.values())
        if self._pending and self._pending_bytes + size > MAX_FILE_BYTES:
            self._write_pending()
        self._pending.append(columns)
        self._pending_bytes += size
        chunk_index, file_index = divmod(self._file, CHUNK_FILES)
        row = {"episode_index": len(self._rows), "tasks": [task], "length": len(frames)}
        row |= {"data/chunk_index": chunk_index, "data/file_index": file_index}
        row |= {"dataset_from_index": self._frames, "dataset_to_index": self._frames + len(frames)}
        self._rows.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        self._statistics.append({name: feature_statistics(values) for name, values in columns.items()})
        self._frames += len(frames)

    def finish(self, tools: list[dict[str, Any]]) -> None:
        """Write the remaining frames and the folder `meta`; `tools` are the schemas of the skills."""
        self._write_pending()
        write_tasks(self._folder / "meta" / "tasks.parquet", list(self._tasks))
        write_episodes(self._folder / EPISODES_PATH, self._rows, self._statistics)
        self._write_json("stats.json", plain_statistics(aggregate_statistics(self._statistics)))
        self._write_json("info.json", self._info(tools))

    def _columns(self, frames: Frames, task_index: int) -> Columns:
        """The column of each feature, in the order of the features."""
        numbers = np.arange(len(frames))
        found: Columns = {
            "observation.state": frames.q,
            "action": frames.action,
            "dualbrain.u_nom": frames.u_nom,
            "dualbrain.delta": frames.delta,
            "dualbrain.h_min": frames.h_min,
            "dualbrain.status": frames.status,
            "intervention": frames.intervention,
            "dualbrain.opening": frames.opening,
            "timestamp": (numbers / self._fps).astype(np.float32),
            "frame_index": numbers,
            "episode_index": np.full(len(frames), len(self._rows)),
            "index": numbers + self._frames,
            "task_index": np.full(len(frames), task_index),
        }
        return {name: _stored(found[name]) for name in self._features}

    def _write_pending(self) -> None:
        columns = {name: np.concatenate([one[name] for one in self._pending]) for name in self._features}
        chunk_index, file_index = divmod(self._file, CHUNK_FILES)
        write_frames(self._folder / DATA_PATH.format(chunk_index=chunk_index, file_index=file_index), columns)
        self._pending, self._pending_bytes, self._file = [], 0, self._file + 1

    def _info(self, tools: list[dict[str, Any]]) -> dict[str, Any]:
        return {
            "codebase_version": CODEBASE_VERSION,
            "fps": self._fps,
            "features": self._features,
            "total_episodes": len(self._rows),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": MAX_FILE_BYTES >> 20,
            "video_files_size_in_mb": 200,
            "data_path": DATA_PATH,
            "video_path": None,
            "robot_type": self._robot_type,
            "splits": {"train": f"0:{len(self._rows)}"},
            "tools": tools,
        }

    def _write_json(self, name: str, content: Any) -> None:
        path = self._folder / "meta" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(content), indent=4) + b"\n")


def _stored(values: NDArray[Any]) -> NDArray[Any]:
    """The column as it is stored: a feature of one entry is a scalar."""
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
