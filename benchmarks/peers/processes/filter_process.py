"""The parent's side: one living child process for each contestant, asked in turn."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.peers.benchmarked_filters import BenchmarkedFilter

ROOT = Path(__file__).resolve().parents[3]
SINGLE_THREAD_ENV = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_ENABLE_X64": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "PYTHONWARNINGS": "ignore",
}
"""One thread and float64 for everybody: what cbfpy's documentation recommends on a CPU."""


class FilterUnavailableError(Exception):
    """A contestant cannot do what it was asked to."""


class FilterProcess:
    """A contestant's process."""

    def __init__(self, contestant: BenchmarkedFilter) -> None:
        self.entry, self.import_s = contestant, float("nan")
        if not contestant.python.exists():
            raise FilterUnavailableError(f"no environment {contestant.environment!r}")
        own = os.environ.get("PYTHONPATH") if contestant.environment is None else None
        path = os.pathsep.join([str(ROOT), *([own] if own else [])])
        quiet = ["-S"] if sys.flags.no_site and contestant.environment is None else []
        self._process = subprocess.Popen(
            [str(contestant.python), *quiet, "-m", "benchmarks.peers.processes.worker", contestant.module],
            cwd=ROOT,
            env=os.environ | SINGLE_THREAD_ENV | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self._buffer = b""
        try:
            self.import_s = self._receive(120.0)["import_s"]
        except FilterUnavailableError:
            self.close()
            raise

    def request(self, do: str, timeout_s: float = 300.0, **what: Any) -> dict[str, Any]:
        """Send one question and wait for its answer; `Refused` when there is none."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": do, **what}).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise FilterUnavailableError("its process has ended") from None
        return self._receive(timeout_s)

    def _receive(self, timeout_s: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        end, pipe = time.monotonic() + timeout_s, self._process.stdout.fileno()
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([pipe], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                self.close()
                raise FilterUnavailableError(f"no answer within {timeout_s:.0f} s")
            piece = os.read(pipe, 1 << 16)
            if not piece:
                raise FilterUnavailableError("its process has ended")
            self._buffer += piece
        line, _, self._buffer = self._buffer.partition(b"\n")
        answer = json.loads(line)
        if "refused" in answer:
            raise FilterUnavailableError(answer["refused"])
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
