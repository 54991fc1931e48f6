"""The model's state after the unchanging part of the prompt, kept on disk between processes.

Reading the rules and examples costs a small machine a minute; restoring the state costs milliseconds (30 KB a token). A
state is valid only for the same model, adapters, scales, runtime and text, so the file is named by the hash of them
all: nothing else can be found under that name (llama.cpp itself would restore a state under any adapter). A server that
cannot restore it reads the prompt as if there were none.
"""

from __future__ import annotations

import hashlib
import json
from importlib.metadata import version
from pathlib import Path

from dualbrain.planner.asking import FULL, Asking
from dualbrain.planner.chat import post
from dualbrain.planner.llama_process import Worn
from dualbrain.planner.request import PlanRequest

_LIMIT_S = 20.0
"""For one save or restore [s]."""


class PrefixStore:
    """Saves and restores slot 0 of the llama.cpp server at `address` in `folder`; does nothing without a folder."""

    def __init__(
        self, folder: Path | None, model: Path, n_ctx: int, address: str, key: str, *, asking: Asking = FULL,
        adapters: tuple[Worn, ...] = (),
    ) -> None:  # fmt: skip
        self._folder, self._model, self._n_ctx, self._address, self._key = folder, model, n_ctx, address, key
        self._asking, self._adapters = asking, adapters

    def restore(self, request: PlanRequest) -> bool:
        """Load the state for `request`, if there is one."""
        path = self.path(request)
        return path is not None and path.is_file() and self._tell("restore", path)

    def save(self, request: PlanRequest) -> bool:
        """Keep the state that the server has after answering `request`, in place of older ones of the same model.

        Only while memory is empty: recalled exemplars change from question to question.
        """
        path = self.path(request)
        if path is None or path.is_file() or request.recall.exemplars:
            return False
        for old in path.parent.glob(f"{self._model.stem}-*.slot"):
            old.unlink()
        return self._tell("save", path)

    def path(self, request: PlanRequest) -> Path | None:
        """The file for all messages of `request` but the last, with this model, runtime and context size."""
        if self._folder is None:
            return None
        state = self._model.stat()
        model: list[object] = [self._model.name, state.st_size, state.st_mtime_ns, self._n_ctx, version("xllamacpp")]
        model += [[one.id, one.scale] for one in self._adapters]
        prefix = self._asking.messages(request)[:-1]
        digest = hashlib.sha256(json.dumps([model, prefix]).encode()).hexdigest()[:24]
        return self._folder / f"{self._model.stem}-{digest}.slot"

    def _tell(self, action: str, path: Path) -> bool:
        url = f"{self._address}/slots/0?action={action}"
        answer = post(url, json.dumps({"filename": path.name}).encode(), key=self._key, timeout_s=_LIMIT_S)
        return isinstance(answer, tuple) and answer[0] == 200
