"""Checks of the files of a release that install nothing."""

from __future__ import annotations

import tarfile
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from tools.release.distributions import Distributions
from tools.release.environments import ROOT, Environment, run_program

MAX_WHEEL_BYTES = 12_000_000
"""Largest wheel of a release [bytes]."""
MAX_SDIST_BYTES = 12_000_000
"""Largest source distribution of a release [bytes]."""
REFUSED_FOLDERS = (
    ".ci",
    ".github",
    ".venv",
    "build",
    "dist",
    "runs",
    "docs/images",
    "docs/results",
    "experiments/logs",
)
"""Folders that a source distribution must not contain."""
REFUSED_SUFFIXES = (".parquet", ".gif", ".mp4", ".png", ".svg", ".xz", ".pyc", ".so", ".gguf")
"""File types that a source distribution contains only below `src` and `tests`."""
REQUIRED_FILES = ("CMakeLists.txt", "LICENSE", "README.md", "pyproject.toml", "src/dualbrain/__init__.py")
"""Files that every source distribution contains."""


def check_files(found: Distributions, tools: Environment) -> list[str]:
    """Problems of the distributions: of their metadata, their contents, their size, and their use of Python's ABI."""
    run_program([tools.program("twine"), "check", "--strict", *found.files])
    run_program([tools.program("check-wheel-contents"), "--config", ROOT / "pyproject.toml", *found.wheels])
    if found.abi3_wheel is not None:
        run_program([tools.program("abi3audit"), "--strict", found.abi3_wheel])
    problems = [f"{found.sdist.name}: {line}" for line in sdist_problems(sdist_names(found.sdist))]
    limits = [(found.sdist, MAX_SDIST_BYTES), *((wheel, MAX_WHEEL_BYTES) for wheel in found.wheels)]
    return problems + [
        f"{path.name} has {path.stat().st_size} bytes, at most {limit} are allowed"
        for path, limit in limits
        if path.stat().st_size > limit
    ]


def sdist_names(sdist: Path) -> list[str]:
    """Paths of the files in `sdist`, relative to its top folder."""
    with tarfile.open(sdist) as archive:
        return [name.partition("/")[2] for name in archive.getnames()]


def sdist_problems(names: Iterable[str]) -> list[str]:
    """One sentence for each file in `names` that a source distribution must not contain, and for each missing one."""
    names = list(names)
    problems = [f"{name} does not belong into a source distribution" for name in names if _is_refused(name)]
    return problems + [f"{name} is missing" for name in REQUIRED_FILES if name not in names]


def _is_refused(name: str) -> bool:
    path = PurePosixPath(name)
    kept = path.parts[:1] in (("src",), ("tests",)) and path.suffix not in (".pyc", ".so")
    return any(path.is_relative_to(folder) for folder in REFUSED_FOLDERS) or (
        path.suffix in REFUSED_SUFFIXES and not kept
    )
