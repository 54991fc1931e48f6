"""The model's state after the unchanging part of the prompt, kept on disk between processes.

Reading the rules and examples costs a small machine a minute; restoring the state costs milliseconds (30 KB a token). A
state is valid only for the same model, adapters, scales, runtime and text, so the file is named by the hash of them
all: nothing else can be found under that name (llama.cpp itself would restore a state under any adapter). A model whose
SHA-256 was verified is known by that, a file of somebody's own by name, size and date. Beside it stands the SHA-256 of
what was saved, for llama.cpp also restores a damaged state without a word. The name has two parts, one for
the rules and one for the examples after them: where recalled exemplars stand in their place, a state with the same
rules serves as well, and the server reads on from where the two part. A server that cannot restore it reads the prompt
as if there were none.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from dualbrain.core.weights import verified_hash
from dualbrain.planner.backends.http_chat import post
from dualbrain.planner.backends.llama_process import LoadedAdapter
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, PromptFormat
from dualbrain.planner.request import PlanRequest

_TIMEOUT_S = 20.0
"""For one save or restore [s]."""
MAX_CACHED_STATES = 6
"""States of one model that are kept, of some 30 MB each: one for each robot, with and without exemplars."""


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
        prompt_format: PromptFormat = FULL_PROMPT,
        adapters: tuple[LoadedAdapter, ...] = (),
    ) -> None:
        self._folder, self._model, self._n_ctx, self._address, self._key = folder, model, n_ctx, address, key
        self._prompt_format, self._adapters = prompt_format, adapters

    def restore(self, request: PlanRequest) -> bool:
        """Load a state for `request`, if there is one: of the same beginning, else the newest of the same rules."""
        path = self.state_path(request)
        found = [] if path is None else [path, *self._states_with_rules(path)]
        whole = next((one for one in found if _is_intact(one)), None)
        return whole is not None and self._post_slot_action("restore", whole)

    def save(self, request: PlanRequest) -> bool:
        """Keep the state that the server has after answering `request`, and no more than `KEPT` of the model.

        Recalled exemplars change from question to question: with them it is kept only where none has the same rules.
        """
        path = self.state_path(request)
        if path is None or _has_checksum(path) or (request.recall.exemplars and self._states_with_rules(path)):
            return False
        for old in _newest_first(path.parent.glob(f"{self._model.stem}-*.slot"))[MAX_CACHED_STATES - 1 :]:
            _remove(old)
        return self._post_slot_action("save", path) and _write_checksum(path)

    def state_path(self, request: PlanRequest) -> Path | None:
        """The file for all messages of `request` but the last, with this model, runtime and context size."""
        if self._folder is None:
            return None
        model = [*_model_identity(self._model), self._n_ctx, version("xllamacpp")]
        model += [[one.id, one.scale] for one in self._adapters]
        prefix = self._prompt_format.messages(request)[:-1]
        return self._folder / f"{self._model.stem}-{_digest([model, prefix[:1]])}-{_digest(prefix[1:])}.slot"

    def rules_key(self, request: PlanRequest) -> str:
        """What tells whether two requests begin alike: "" without a folder."""
        path = self.state_path(request)
        return "" if path is None else _rules_key(path)

    def _states_with_rules(self, path: Path) -> list[Path]:
        """States with the same rules as `path`, the newest first."""
        return _newest_first(one for one in path.parent.glob(f"{_rules_key(path)}-*.slot") if _has_checksum(one))

    def _post_slot_action(self, action: str, path: Path) -> bool:
        url = f"{self._address}/slots/0?action={action}"
        answer = post(url, json.dumps({"filename": path.name}).encode(), key=self._key, timeout_s=_TIMEOUT_S)
        return isinstance(answer, tuple) and answer[0] == 200


def _model_identity(model: Path) -> list[object]:
    """What tells one model file from another without reading it: the hash that was verified, else name, size, date."""
    state = model.stat()
    return [found] if (found := verified_hash(model)) else [model.name, state.st_size, state.st_mtime_ns]


def _digest(told: object) -> str:
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:24]


def _rules_key(path: Path) -> str:
    """The part of a file's name that stands for the model and the rules."""
    return path.stem.rpartition("-")[0]


def _newest_first(paths: Iterable[Path]) -> list[Path]:
    """`paths` by date; one that was pruned meanwhile is left out."""
    dated: list[tuple[int, Path]] = []
    for path in paths:
        with suppress(FileNotFoundError):
            dated.append((path.stat().st_mtime_ns, path))
    return [path for _, path in sorted(dated, reverse=True)]


def _checksum_path(path: Path) -> Path:
    """Where the SHA-256 of a state stands."""
    return path.with_suffix(".sha256")


def _has_checksum(path: Path) -> bool:
    return path.is_file() and _checksum_path(path).is_file()


def _write_checksum(path: Path) -> bool:
    """Write the SHA-256 of the state at `path` beside it; False, and no state, if that cannot be done."""
    try:
        _checksum_path(path).write_text(_file_hash(path))
    except OSError:
        _remove(path)
        return False
    return True


def _is_intact(path: Path) -> bool:
    """Whether the state at `path` is as it was saved; one that is not is removed."""
    if not _has_checksum(path):
        return False
    with suppress(OSError, ValueError):
        if _checksum_path(path).read_text() == _file_hash(path):
            return True
    _remove(path)
    return False


def _file_hash(path: Path) -> str:
    """SHA-256 of a file: some 50 ms for 50 MB."""
    with path.open("rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()


def _remove(path: Path) -> None:
    """Remove a state, the signature first, whoever else does so; what stays does no harm."""
    for one in (_checksum_path(path), path):
        with suppress(OSError):
            one.unlink()
