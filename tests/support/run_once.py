"""Work that is done once for all test processes: the first one does it, and the others read its results."""

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any


def run_once(factory, name: str, make: Callable[[Path], tuple[Any, ...]]) -> tuple[Any, ...]:
    """(folder, *result of `make(folder)`), with one folder for all processes, which tests only read."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, result = shared / f"once_{name}", shared / f"once_{name}.pickle"
    with (shared / f"once_{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not result.exists():
            folder.mkdir()
            result.write_bytes(pickle.dumps(make(folder)))
    return (folder, *pickle.loads(result.read_bytes()))
