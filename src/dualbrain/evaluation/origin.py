"""Where results come from: versions, a hash of the code, the machine."""

from __future__ import annotations

import hashlib
import platform
from importlib import metadata
from pathlib import Path

import dualbrain
from dualbrain.planner.prompt import template_hash
from dualbrain.planner.short_prompt import short_template_hash
from dualbrain.safety.native import kernel_hash

TELLS = (
    "changes", "contrasts", "decisions", "gallery", "grids", "host", "hypotheses", "markdown", "missing",
    "report_tables", "statistics", "words",
)  # fmt: skip
"""Modules of the evaluation that only tell what was found, as `cli` and `dashboard` do; they change no episode."""
PACKAGES = (
    "numpy", "scipy", "mujoco", "msgspec", "jsonschema-rs", "xllamacpp", "llguidance", "tokenizers", "onnxruntime",
    "torch", "transformers",
)  # fmt: skip
"""What moves the robot and what decides an answer. The manifest of weights is hashed with the code."""


def origin() -> dict[str, str]:
    """Versions and hashes of everything that a result may depend on but the processor: equal ones give equal results.

    Near-ties of a model may fall the other way on another processor.
    """
    found = {"dualbrain": dualbrain.__version__, "code": code_hash(), "kernel": kernel_hash(),
             "prompt": template_hash(), "short prompt": short_template_hash(), "python": platform.python_version(),
             "machine": f"{platform.system()} {platform.machine()}"}  # fmt: skip
    for package in PACKAGES:
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
        tells = inside.parts[0] in ("cli", "dashboard") or (inside.parts[0] == "evaluation" and path.stem in TELLS)
        if path.suffix in (".py", ".toml", ".json", ".xml") and not tells:
            digest.update(str(inside).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
