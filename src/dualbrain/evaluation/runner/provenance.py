"""Provenance of results: versions, a hash of the code, the git revision, the machine."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

import dualbrain
from dualbrain.planner.prompt.full_prompt import local_template_hash, template_hash
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.safety.cbf.kernel import kernel_hash

REPORTING = (
    "cli",
    "visualization",
    "evaluation/report",
    "evaluation/evidence",
    "evaluation/analysis/hypotheses.py",
    "evaluation/analysis/statistics.py",
)
"""Parts of the package that only report results; no episode depends on them."""
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
"""Packages that move the robot or compute the planner's answers. The manifest of weights is hashed with the code."""


def collect_provenance() -> dict[str, str]:
    """Versions and hashes of everything that a result may depend on, except the processor.

    Equal provenance gives equal results; on another processor, near-ties of a language model may be decided otherwise.
    """
    found = {
        "dualbrain": dualbrain.__version__,
        "code": code_hash(),
        "kernel": kernel_hash(),
        "prompt": template_hash(),
        "local prompt": local_template_hash(),
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
    """First 12 hex digits of the SHA-256 over the package's sources and data, without `REPORTING`."""
    package = Path(dualbrain.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        inside = path.relative_to(package)
        reports = any(inside.is_relative_to(part) for part in REPORTING)
        if path.suffix in (".py", ".toml", ".json", ".xml") and not reports:
            digest.update(str(inside).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


CPUINFO_PATH = Path("/proc/cpuinfo")
UNKNOWN, NO_CHECKOUT = "unknown", "no checkout"
GIT_TIMEOUT_S = 30.0
"""Time limit of one git command [s]."""


def host_info() -> dict[str, str]:
    """Processor, cores and memory of this machine, and the revision of the code if it is in a git checkout."""
    return {
        "processor": processor_name(),
        "cores": str(os.cpu_count() or UNKNOWN),
        "memory": memory_size(),
        "revision": git_revision(Path(dualbrain.__file__).parent),
    }


def machine_description() -> str:
    """Cores, processor, system and Python version of this machine in one line."""
    python = platform.python_version()
    return f"{os.cpu_count() or UNKNOWN} cores of {processor_name()}, {platform.system()}, Python {python}"


def processor_name() -> str:
    """The processor's name as the system reports it, else its architecture."""
    lines = CPUINFO_PATH.read_text("utf-8", "replace").splitlines() if CPUINFO_PATH.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine() or UNKNOWN)


def memory_size() -> str:
    """The machine's memory in GiB."""
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return UNKNOWN
    return f"{size / 2**30:.1f} GiB"


def git_revision(package: Path, folders: Sequence[str] = ()) -> str:
    """The commit of the checkout that contains `package`, 12 hex digits, or "no checkout".

    Uncommitted changes of tracked files are appended as `+` and 6 hex digits of their SHA-256; with `folders`, only
    changes in these top-level folders of the checkout count. A package that is merely installed inside a checkout (its
    `__init__.py` is not tracked) has no revision.
    """
    try:
        _run_git(package, "ls-files", "--error-unmatch", "__init__.py")
        commit = _run_git(package, "rev-parse", "--short=12", "HEAD")
        pathspecs = [f":(top){folder}" for folder in folders]
        changes = _run_git(package, "diff", "--no-ext-diff", "--binary", "HEAD", "--", *pathspecs)
    except (OSError, subprocess.SubprocessError):
        return NO_CHECKOUT
    digest = hashlib.sha256(changes.encode("utf-8", "surrogateescape")).hexdigest()[:6]
    return f"{commit}+{digest}" if changes else commit


def _run_git(folder: Path, *arguments: str) -> str:
    """Output of a git command that changes nothing."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, errors="surrogateescape", check=True, timeout=GIT_TIMEOUT_S
    )
    return done.stdout.strip()
