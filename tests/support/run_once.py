"""Work that is done once however many processes run the tests: the first one does it, the others read what it left."""

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any


def run_once(factory, name: str, make: Callable[[Path], tuple[Any, ...]]) -> tuple[Any, ...]:
    """(folder, *what `make(folder)` returned), with one folder for all; tests read there and change nothing."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, result = shared / f"once_{name}", shared / f"once_{name}.pickle"
    with (shared / f"once_{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not result.exists():
            folder.mkdir()
            result.write_bytes(pickle.dumps(make(folder)))
    return (folder, *pickle.loads(result.read_bytes()))
