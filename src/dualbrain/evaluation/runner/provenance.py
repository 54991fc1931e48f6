"""Where results come from: versions, a hash of the code, the machine."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

import dualbrain
from dualbrain.planner.prompt.full_prompt import template_hash
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.safety.cbf.kernel import kernel_hash

REPORTING = (
    "cli",
    "visualization",
    "evaluation/report",
    "evaluation/analysis/hypotheses.py",
    "evaluation/analysis/statistics.py",
)
"""Parts of the package that report results; no episode depends on them."""
RECORDED_PACKAGES = (
    "numpy",
    "scipy",
    "mujoco",
    "msgspec",
    "jsonschema-rs",
    "xllamacpp",
    "llguidance",
    "tokenizers",
    "onnxruntime",
    "torch",
    "transformers",
)
"""What moves the robot and what decides an answer. The manifest of weights is hashed with the code."""


def collect_provenance() -> dict[str, str]:
    """Versions and hashes of everything that a result may depend on but the processor: equal ones give equal results.

    Near-ties of a model may fall the other way on another processor.
    """
    found = {
        "dualbrain": dualbrain.__version__,
        "code": code_hash(),
        "kernel": kernel_hash(),
        "prompt": template_hash(),
        "short prompt": short_template_hash(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
    for package in RECORDED_PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def code_hash() -> str:
    """First 12 hex digits of the SHA-256 over the package's sources and data, without what only tells and draws."""
    package = Path(dualbrain.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        inside = path.relative_to(package)
        reports = any(inside.is_relative_to(part) for part in REPORTING)
        if path.suffix in (".py", ".toml", ".json", ".xml") and not reports:
            digest.update(str(inside).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


CPUINFO_PATH = Path("/proc/cpuinfo")
UNKNOWN = "unknown"
GIT_TIMEOUT_S = 30.0
"""Wall time that git may take [s]."""


def host_info() -> dict[str, str]:
    """Processor, cores, memory, and the revision of the code where it lies in a git checkout."""
    return {
        "processor": processor_name(),
        "cores": str(os.cpu_count() or UNKNOWN),
        "memory": memory_size(),
        "revision": git_revision(Path(dualbrain.__file__).parent),
    }


def processor_name() -> str:
    """The processor's name as the system tells it."""
    lines = CPUINFO_PATH.read_text("utf-8", "replace").splitlines() if CPUINFO_PATH.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or UNKNOWN)


def memory_size() -> str:
    """The machine's memory."""
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return UNKNOWN
    return f"{size / 2**30:.1f} GiB"


def git_revision(package: Path) -> str:
    """The commit of the checkout that holds `package`, `-dirty` if files differ from it; else that there is none.

    A package that was only installed somewhere inside a checkout is not of its revision.
    """
    try:
        _run_git(package, "ls-files", "--error-unmatch", "__init__.py")
        return _run_git(package, "describe", "--always", "--dirty", "--abbrev=12", "--exclude", "*")
    except (OSError, subprocess.SubprocessError):
        return "no checkout"


def _run_git(folder: Path, *words: str) -> str:
    """What git says, which changes nothing."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=GIT_TIMEOUT_S).stdout.strip()
