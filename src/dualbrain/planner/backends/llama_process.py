"""The worker process with the model, as its parent starts, queries and stops it."""

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
    """An adapter in llama.cpp: its GGUF-LoRA file, its `id` (content hash), and its scale (1: as trained)."""

    path: Path
    id: str
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class FileState:
    """Device, inode, size [bytes] and date [ns] of a file, of which one differs once it was replaced or rewritten."""

    device: int
    inode: int
    size: int
    modified_ns: int


def read_file_state(path: Path) -> FileState | None:
    """The state of the file at `path`, None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return FileState(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class LlamaConfig:
    """Settings of the model.

    `threads`: 1 beside a control loop, more only on idle cores. `n_ctx` and `max_tokens` are in tokens (eight actions
    fit). `timeout_s` [s] limits one proposal, including loading the model. `prompt_cache` is an existing folder for the
    state after the constant part of the prompt, so that the next process need not read this part again.
    `jump_forward`: read text that the grammar forces in batches (`decoding/jump_forward.py`).
    """

    threads: int = 1
    n_ctx: int = 6144
    max_tokens: int = 640
    timeout_s: float = 600.0
    prompt_cache: Path | None = None
    jump_forward: bool = True


DEFAULT_CONFIG = LlamaConfig()


class LlamaProcess:
    """One worker process for one model and one fixed set of adapters.

    It listens on loopback only, with a random key. Adapters are applied only in requests that name them.
    """

    def __init__(self, model: Path, config: LlamaConfig, adapters: tuple[LoadedAdapter, ...] = ()) -> None:
        """Start the process; it loads the model while the caller continues."""
        self.key = secrets.token_urlsafe(24)
        self.state: Path | None = None
        """File of the state that its last answer began with (`PromptCache.state_path`); None before the first one."""
        self.loaded_file = read_file_state(model)
        """State of the model file before it was loaded."""
        self._address = ""
        self._load_fix = (
            f"Is {model.name} a complete GGUF file of a model that llama.cpp supports? If it is a model file of "
            "dualbrain, delete it and get it again with `dualbrain models fetch NAME`."
        )
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_WORKER_SCRIPT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C reaches the parent only, which then stops the worker
        )
        assert self._process.stderr is not None
        self._stderr_tail = StderrTail(self._process.stderr, secret=self.key)
        settings: dict[str, Any] = {"model": str(model), "n_ctx": config.n_ctx, "threads": config.threads}
        settings |= {"key": self.key, "prompt_cache": f"{config.prompt_cache}/" if config.prompt_cache else ""}
        settings["adapters"] = [str(one.path) for one in adapters]
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # the process died at once: `wait_for_address` reports it
            self._process.stdin.write(json.dumps(settings).encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def is_ready(self) -> bool:
        """Whether the process has sent its address."""
        return bool(self._address)

    def has_exited(self) -> bool:
        """Whether the process has ended; waits up to 0.5 s, because its socket closes before the process ends."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=0.5)
        return self._process.poll() is not None

    def crash_response(self) -> ChatResponse:
        """The response for a process that has ended: its exit status and the end of its standard error."""
        details = (describe_exit(self._process.wait()), self._stderr_tail.text())
        return ChatResponse(text="", finish_reason=protocol.CRASHED, detail=": ".join(filter(None, details)))

    def wait_for_address(self, timeout_s: float) -> tuple[str, ChatResponse | None]:
        """The address of the worker, or the reason why there is none; waits up to `timeout_s` [s] while it loads."""
        if self._address:
            return self._address, None
        out = self._process.stdout
        assert out is not None
        if not select.select([out], [], [], timeout_s)[0]:
            return "", ChatResponse(text="", finish_reason=protocol.TIMEOUT)
        line = out.readline()
        try:
            reply = json.loads(line)
        except ValueError:  # the process died before or while it wrote the line
            self._process.wait()
            return "", self.crash_response()
        self._address = reply.get("address", "")
        return self._address, None if self._address else ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"{reply['error'].rstrip('.')}. {self._load_fix}"
        )

    def close(self) -> None:
        """Close the input of the process, which ends it; kill it after 1 s."""
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
