"""The process that holds the model, seen from its parent: from its start to its end."""

from __future__ import annotations

import json
import secrets
import select
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.stderr_tail import StderrTail, describe_exit

_WORKER_SCRIPT = Path(__file__).with_name("llama_worker.py")


@dataclass(frozen=True, slots=True)
class LoadedAdapter:
    """An adapter in llama.cpp: its GGUF-LoRA file, its `id` (content), how strongly it acts (1: as it was fitted)."""

    path: Path
    id: str
    scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LlamaConfig:
    """How the model runs.

    `threads`: 1 beside a control loop, more only on idle cores. `n_ctx` and `max_tokens` in tokens (eight actions fit).
    `timeout_s`: for one proposal, including the load of the model [s]. `prefixes`: an existing folder in which the
    state after the unchanging part of the prompt is kept, so that the next process need not read it again.
    """

    threads: int = 1
    n_ctx: int = 6144
    max_tokens: int = 640
    timeout_s: float = 600.0
    prompt_cache: Path | None = None


DEFAULT_CONFIG = LlamaConfig()


class LlamaProcess:
    """One process for one model and one set of adapters; no adapter can be added to it, or changed by anybody else.

    It listens on loopback only, behind a random key. Adapters do nothing until a request names them.
    """

    def __init__(self, model: Path, config: LlamaConfig, adapters: tuple[LoadedAdapter, ...] = ()) -> None:
        """Start it; it loads while the caller goes on."""
        self.key = secrets.token_urlsafe(24)
        self.cached_rules: str | None = None
        """The rules that it has read last, as `PrefixStore.rules` tells them."""
        self._address = ""
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_WORKER_SCRIPT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the parent, which ends the child in order
        )
        assert self._process.stderr is not None
        self._stderr_tail = StderrTail(self._process.stderr, secret=self.key)
        settings: dict[str, Any] = {"model": str(model), "n_ctx": config.n_ctx, "threads": config.threads}
        settings |= {"key": self.key, "prefixes": f"{config.prompt_cache}/" if config.prompt_cache else ""}
        settings["adapters"] = [str(one.path) for one in adapters]
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it died at once: `address` will say so
            self._process.stdin.write(json.dumps(settings).encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def is_ready(self) -> bool:
        """Whether it has said where it listens."""
        return bool(self._address)

    def has_exited(self) -> bool:
        """Whether it has ended; a socket breaks a moment before its process is gone."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=0.5)
        return self._process.poll() is not None

    def crash_response(self) -> ChatResponse:
        """Why there is no answer of a process that has ended: how it ended, and its last words."""
        told = (describe_exit(self._process.wait()), self._stderr_tail.text())
        return ChatResponse(text="", finish_reason=protocol.CRASHED, detail=": ".join(filter(None, told)))

    def wait_for_address(self, timeout_s: float) -> tuple[str, ChatResponse | None]:
        """Where the child listens, or why it does not; waits while it loads."""
        if self._address:
            return self._address, None
        out = self._process.stdout
        assert out is not None
        if not select.select([out], [], [], timeout_s)[0]:
            return "", ChatResponse(text="", finish_reason=protocol.TIMEOUT)
        line = out.readline()
        try:
            told = json.loads(line)
        except ValueError:  # it died before it, or in the midst of it
            self._process.wait()
            return "", self.crash_response()
        self._address = told.get("address", "")
        return self._address, None if self._address else ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=told["error"]
        )

    def close(self) -> None:
        """Close its input, which ends it; kill it when it does not answer to that."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._stderr_tail.close()
