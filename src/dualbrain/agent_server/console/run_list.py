"""The runs in a folder, as far as the console shows them; every file is untrusted."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.agent_api.saved_runs import EPISODE_FILE, REPORT_FILE
from dualbrain.core.text import storable_text
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import DECODE_ERRORS

MAX_EPISODE_BYTES, MAX_REPORT_BYTES = 8 << 20, 64 << 20
"""Largest files that are read [bytes]."""
MAX_RUNS = 200
"""Number of runs that are listed, the newest."""
MAX_TEXT = 400
"""Longest text of an entry [characters]."""


class _Outcome(msgspec.Struct, frozen=True, kw_only=True):
    kind: str
    reason: str = ""
    Delta: float | None = None  # Δ(τ) of the paper
    h_min: float | None = None
    duration: float = 0.0


class _Hit(msgspec.Struct, frozen=True):
    episode_id: str = ""


class _Passage(msgspec.Struct, frozen=True):
    citation: str = ""


class _Recall(msgspec.Struct, frozen=True):
    exemplars: tuple[_Hit, ...] = ()
    warnings: tuple[_Hit, ...] = ()
    passages: tuple[_Passage, ...] = ()


class _Episode(msgspec.Struct, frozen=True, kw_only=True):
    started: str
    instruction: str
    robot: str
    outcome: _Outcome
    recall: _Recall = _Recall()
    second_opinion: str = "none"


def list_runs(folder: Path) -> dict[str, Any]:
    """The runs in `folder`, the newest first, and the number of those that are not listed or cannot be read."""
    names = dict[str, float]()
    with suppress(OSError), os.scandir(folder) as entries:
        for one in entries:
            with suppress(OSError):  # a run may be deleted meanwhile
                if _is_folder(one):
                    names[one.name] = one.stat(follow_symlinks=False).st_mtime
    newest = sorted(names, key=lambda name: (names[name], name), reverse=True)
    found = [_entry(folder, name) for name in newest[:MAX_RUNS]]
    listed = [one for one in found if one is not None]
    return {"runs": listed, "omitted": len(names) - len(listed)}


def read_report(folder: Path, name: str) -> bytes | FileRefusal:
    """The report of the run called `name` in `folder`; links are not followed, and other folders cannot be named."""
    if not _is_name(name) or (folder / name).is_symlink():
        return FileRefusal("missing", "There is no such run.", "Load the list of runs again.")
    return read_regular_file(folder / name / REPORT_FILE, MAX_REPORT_BYTES, follow_links=False)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    return entry.is_dir(follow_symlinks=False)


def _is_name(name: str) -> bool:
    return bool(name) and name not in (".", "..") and not set("/\\\0") & set(name)


def _entry(folder: Path, name: str) -> dict[str, Any] | None:
    data = read_regular_file(folder / name / EPISODE_FILE, MAX_EPISODE_BYTES, follow_links=False)
    if isinstance(data, FileRefusal):
        return None
    try:
        episode = msgspec.json.decode(data, type=_Episode)
    except DECODE_ERRORS:
        return None
    outcome, recall = episode.outcome, episode.recall
    return {
        "name": name,
        "started": storable_text(episode.started, MAX_TEXT),
        "instruction": storable_text(episode.instruction, MAX_TEXT),
        "robot": storable_text(episode.robot, MAX_TEXT),
        "outcome": storable_text(outcome.kind, MAX_TEXT),
        "reason": storable_text(outcome.reason, MAX_TEXT),
        "senses": storable_text(episode.second_opinion, MAX_TEXT),
        "delta": outcome.Delta,
        "clearance": outcome.h_min,
        "duration": outcome.duration,
        "cites": [
            storable_text(one, MAX_TEXT)
            for one in (
                *(hit.episode_id for hit in (*recall.exemplars, *recall.warnings)),
                *(passage.citation for passage in recall.passages),
            )
        ],
        "report": (folder / name / REPORT_FILE).is_file(),
    }
