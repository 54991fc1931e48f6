"""Cache on disk for the state of the model after the constant part of the prompt.

Reading the rules and examples takes a small machine a minute; restoring the state takes milliseconds (30 KB per token).
A state is valid only for the same model, adapters, scales, runtime and text, so the file name contains a hash of all of
them; llama.cpp itself would restore a state under any adapter. A model is identified by its SHA-256 if that was
verified, otherwise by name, size and date. A model file that was replaced or deleted since the server loaded it
identifies no state: then none is restored or saved. A file with the SHA-256 of the state is beside it, because
llama.cpp silently restores damaged states. The file name has two hashes: one for the rules and one for the examples
after them. Each selection of built-in examples has its own state. If retrieved exemplars follow them, a state with the
same rules is valid as well, and the server reads on from the first difference. A server that cannot restore a state
reads the whole prompt.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from dualbrain.core.storage.atomic_files import FileWriteError, write_atomically
from dualbrain.core.storage.checksum import file_sha256
from dualbrain.core.storage.private_files import tighten
from dualbrain.core.weights import verified_hash
from dualbrain.planner.backends.http_chat import post
from dualbrain.planner.backends.llama_process import FileState, LoadedAdapter, read_file_state
from dualbrain.planner.prompt.prompt_format import PromptFormat
from dualbrain.planner.request import PlanRequest

_TIMEOUT_S = 20.0
"""Time limit for saving or restoring a state [s]."""
MAX_CACHED_STATES = 8
"""Largest number of states per model, of about 60 MB each: one for each robot and selection of examples."""


class PromptCache:
    """Saves and restores slot 0 of the llama.cpp server at `address` in `folder`; does nothing without a folder.

    Other processes may save and prune in the same folder at any time.
    """

    def __init__(
        self,
        folder: Path | None,
        model: Path,
        n_ctx: int,
        address: str,
        key: str,
        *,
        prompt_format: PromptFormat,
        loaded_file: FileState | None,
        adapters: tuple[LoadedAdapter, ...] = (),
    ) -> None:
        """`loaded_file` is the state of the file at `model` when the server was started."""
        self._folder, self._model, self._n_ctx, self._address, self._key = folder, model, n_ctx, address, key
        self._prompt_format, self._loaded_file, self._adapters = prompt_format, loaded_file, adapters

    def restore(self, request: PlanRequest, present: Path | None = None) -> bool:
        """Restore a state for `request`: one with the same prefix, otherwise the newest with the same rules.

        `present` is the state that the server began its last answer with: if it has the same rules, only a state with
        the same prefix saves reading. Returns whether a state was restored.
        """
        path = self.state_path(request)
        if path is None:
            return False
        has_rules = present is not None and _rules_key(present) == _rules_key(path)
        candidates = [path] if has_rules else [path, *self._states_with_rules(path)]
        intact = next((one for one in candidates if _is_intact(one)), None)
        if intact is None or not self._post_slot_action("restore", intact):
            return False
        with suppress(OSError):
            os.utime(intact)  # the states that were used last are kept
        return True

    def save(self, request: PlanRequest) -> bool:
        """Save the state of the server after `request`, and keep at most `MAX_CACHED_STATES` of the model.

        Retrieved exemplars differ between requests: a state with them is saved only if none has the same rules.
        Returns whether the state was saved.
        """
        path = self.state_path(request)
        if path is None or _has_checksum(path) or (request.recall.exemplars and self._states_with_rules(path)):
            return False
        of_model = (one for one in path.parent.glob("*.slot") if _model_stem(one) == self._model.stem)
        for old in _newest_first(of_model)[MAX_CACHED_STATES - 1 :]:
            _remove(old)
        return self._post_slot_action("save", path) and _write_checksum(path)

    def state_path(self, request: PlanRequest) -> Path | None:
        """The file for all messages of `request` but the last, with this model, runtime and context size.

        None without a folder, and if the model file is no longer the one that the server has loaded.
        """
        if self._folder is None or self._loaded_file is None:
            return None
        identity = _model_identity(self._model, self._loaded_file)
        if read_file_state(self._model) != self._loaded_file:
            return None
        model = [*identity, self._n_ctx, version("xllamacpp")]
        model += [[one.id, one.scale] for one in self._adapters]
        prefix = self._prompt_format.messages(request)[:-1]
        return self._folder / f"{self._model.stem}-{_digest([model, prefix[:1]])}-{_digest(prefix[1:])}.slot"

    def _states_with_rules(self, path: Path) -> list[Path]:
        """States with the same rules as `path`, newest first."""
        same = (one for one in path.parent.glob("*.slot") if _rules_key(one) == _rules_key(path))
        return _newest_first(one for one in same if _has_checksum(one))

    def _post_slot_action(self, action: str, path: Path) -> bool:
        url = f"{self._address}/slots/0?action={action}"
        reply = post(url, json.dumps({"filename": path.name}).encode(), key=self._key, timeout_s=_TIMEOUT_S)
        return isinstance(reply, tuple) and reply[0] == 200


def _model_identity(model: Path, file: FileState) -> list[object]:
    """Identity of a model file without reading it: its verified hash, otherwise name, size and date."""
    return [digest] if (digest := verified_hash(model)) else [model.name, file.size, file.modified_ns]


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:24]


def _rules_key(path: Path) -> str:
    """The part of a file name that identifies model and rules."""
    return path.stem.rpartition("-")[0]


def _model_stem(path: Path) -> str:
    """The part of a file name that is the stem of the model file; the two hashes follow it."""
    return path.stem.rsplit("-", 2)[0]


def _newest_first(paths: Iterable[Path]) -> list[Path]:
    """`paths` by date, newest first; a file that was removed meanwhile is left out."""
    dated: list[tuple[int, Path]] = []
    for path in paths:
        with suppress(FileNotFoundError):
            dated.append((path.stat().st_mtime_ns, path))
    return [path for _, path in sorted(dated, reverse=True)]


def _checksum_path(path: Path) -> Path:
    """Path of the file with the SHA-256 of a state."""
    return path.with_suffix(".sha256")


def _has_checksum(path: Path) -> bool:
    return path.is_file() and _checksum_path(path).is_file()


def _write_checksum(path: Path) -> bool:
    """Write the SHA-256 of the state at `path` beside it; on failure the state is removed, and the result is False."""
    try:
        tighten(path)
        write_atomically(_checksum_path(path), file_sha256(path).encode())
    except (OSError, FileWriteError):
        _remove(path)
        return False
    return True


def _is_intact(path: Path) -> bool:
    """Whether the state at `path` has its SHA-256; a damaged state is removed."""
    if not _has_checksum(path):
        return False
    with suppress(OSError, ValueError):
        if _checksum_path(path).read_text() == file_sha256(path):
            return True
    _remove(path)
    return False


def _remove(path: Path) -> None:
    """Remove a state after its checksum; other processes may do the same, and leftover files do no harm."""
    for one in (_checksum_path(path), path):
        with suppress(OSError):
            one.unlink()
