"""The machine and the checkout of a run: told beside its results, and no part of what has to be the same to go on."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import dualbrain

CPUINFO = Path("/proc/cpuinfo")
UNKNOWN = "unknown"
PATIENCE = 30.0
"""Wall time that git may take [s]."""


def host() -> dict[str, str]:
    """Processor, cores, memory, and the revision of the code where it lies in a git checkout."""
    return {
        "processor": processor(),
        "cores": str(os.cpu_count() or UNKNOWN),
        "memory": memory(),
        "revision": revision(Path(dualbrain.__file__).parent),
    }


def processor() -> str:
    """The processor's name as the system tells it."""
    lines = CPUINFO.read_text("utf-8", "replace").splitlines() if CPUINFO.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or UNKNOWN)


def memory() -> str:
    """The machine's memory."""
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return UNKNOWN
    return f"{size / 2**30:.1f} GiB"


def revision(package: Path) -> str:
    """The commit of the checkout that holds `package`, `-dirty` if files differ from it; else that there is none.

    A package that was only installed somewhere inside a checkout is not of its revision.
    """
    try:
        _git(package, "ls-files", "--error-unmatch", "__init__.py")
        return _git(package, "describe", "--always", "--dirty", "--abbrev=12", "--exclude", "*")
    except (OSError, subprocess.SubprocessError):
        return "no checkout"


def _git(folder: Path, *words: str) -> str:
    """What git says, which changes nothing."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE).stdout.strip()
