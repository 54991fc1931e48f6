"""Parent side of a filter process: sends requests, receives answers."""

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
"""Environment of all filters: one thread and float64, as the documentation of cbfpy recommends for a CPU."""


class FilterUnavailableError(Exception):
    """A filter has no environment, has failed, or has not answered in time."""


class FilterProcess:
    """Process of a filter."""

    def __init__(self, entry: BenchmarkedFilter) -> None:
        self.entry, self.import_s = entry, float("nan")
        if not entry.python.exists():
            raise FilterUnavailableError(f"no environment {entry.environment!r}")
        own = os.environ.get("PYTHONPATH") if entry.environment is None else None
        path = os.pathsep.join([str(ROOT), *([own] if own else [])])
        flags = ["-S"] if sys.flags.no_site and entry.environment is None else []
        self._process = subprocess.Popen(
            [str(entry.python), *flags, "-m", "benchmarks.peers.processes.worker", entry.module],
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

    def request(self, do: str, timeout_s: float = 300.0, **arguments: Any) -> dict[str, Any]:
        """Send a request and return its answer; raises `FilterUnavailableError` after `timeout_s` without one."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": do, **arguments}).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise FilterUnavailableError("the process has ended") from None
        return self._receive(timeout_s)

    def _receive(self, timeout_s: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        end, pipe = time.monotonic() + timeout_s, self._process.stdout.fileno()
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([pipe], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                self.close()
                raise FilterUnavailableError(f"no answer within {timeout_s:.0f} s")
            data = os.read(pipe, 1 << 16)
            if not data:
                raise FilterUnavailableError("the process has ended")
            self._buffer += data
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
