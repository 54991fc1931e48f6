"""Where figures come from: the revision of the code and the machine."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from pathlib import Path

import dualbrain


def revision(root: Path) -> str:
    """Short hash of the commit; where sources differ from it, "+" and the package's own hash. "unknown" without git."""
    try:
        commit = _git(root, "rev-parse", "--short", "HEAD")
        changed = _git(root, "status", "--porcelain", "-uno", "--", "src", "kernel", "benchmarks", "experiments")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}+{_package_hash()}" if changed else commit


def _package_hash() -> str:
    """Hash over the Python sources that are imported, 6 hex."""
    package = Path(dualbrain.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:6]


def _git(root: Path, *arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()


def machine() -> str:
    """Cores, processor and system."""
    model = next(
        (line.split(":")[1].strip() for line in _cpuinfo() if line.startswith("model name")), platform.machine()
    )
    return f"{os.cpu_count()} cores of {model}, {platform.system()}, Python {platform.python_version()}"


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else []
