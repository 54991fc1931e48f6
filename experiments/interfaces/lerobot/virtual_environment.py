"""LeRobot's virtual environment, build/lerobot/venv, created from requirements.txt.

Run: python -m experiments.interfaces.lerobot.virtual_environment

It installs LeRobot 0.6.1 with a CPU torch (1.6 GB on disk), without dualbrain. LeRobot is fetched by name without its
dependencies and unpacked; files in the syntax of Python 3.12 are translated (`type_parameter_syntax`), and torchvision
gets the declarations of `torchvision_operators`. An existing environment is used again if it was created from the same
requirements and sources, which a digest records.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

from dualbrain.errors import MissingDependencyError
from experiments.interfaces.lerobot.type_parameter_syntax import lower_type_parameters

HERE = Path(__file__).resolve().parent
ENVIRONMENT_FOLDER = HERE.parents[2] / "build" / "lerobot"
REQUIREMENTS = HERE / "requirements.txt"
OPERATORS = HERE / "torchvision_operators.py"
SOURCES = (REQUIREMENTS, OPERATORS, HERE / "type_parameter_syntax.py")
COMMAND = "python -m experiments.interfaces.lerobot.virtual_environment"
ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "OMP_NUM_THREADS": "1", "TOKENIZERS_PARALLELISM": "0"}
"""Variables of every process of the environment: it must not ask a server for a dataset."""


def sources_digest() -> str:
    """Digest of the requirements and of the sources that adapt the environment, 12 hex digits."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in SOURCES)).hexdigest()[:12]


def interpreter(folder: Path = ENVIRONMENT_FOLDER) -> Path:
    """The interpreter of the environment in `folder`.

    Raises `MissingDependencyError` unless it exists and was created from the present sources.
    """
    mark, python = folder / "made-from", folder / "venv" / "bin" / "python"
    if not (mark.exists() and mark.read_text() == sources_digest() and python.exists()):
        fix = f"Create it with `{COMMAND}` (needs a package index)."
        raise MissingDependencyError("The virtual environment of LeRobot", fix=fix)
    return python


def process_environment(folder: Path) -> dict[str, str]:
    """The variables of a process of the environment, whose caches are in `folder`."""
    return {**os.environ, **ENVIRONMENT, "HF_HOME": str(folder)}


def create(folder: Path = ENVIRONMENT_FOLDER) -> Path:
    """Create the environment in `folder` if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    try:
        return interpreter(folder)
    except MissingDependencyError:
        print(f"installing into {folder.name}/venv: {', '.join(required_packages())}", file=sys.stderr)
    venv.create(folder / "venv", with_pip=True, clear=True)
    python = folder / "venv" / "bin" / "python"
    special = ("lerobot==", "torchvision==")
    lerobot, vision = (next(one for one in required_packages() if one.startswith(name)) for name in special)
    _pip(python, "install", "--only-binary", ":all:", *(set(required_packages()) - {lerobot, vision}))
    _pip(python, "install", "--no-deps", vision)  # its wheel asks for another build of torch
    (packages_folder,) = (folder / "venv" / "lib").glob("python3*/site-packages")
    _unpack_lerobot(python, lerobot, packages_folder)
    _declare_operators(packages_folder)
    (folder / "made-from").write_text(sources_digest())
    return python


def required_packages() -> list[str]:
    """The required packages with their versions."""
    return [line for line in REQUIREMENTS.read_text().splitlines() if line and not line.startswith("#")]


def _pip(python: Path, *arguments: str) -> None:
    command = [str(python), "-m", "pip", arguments[0], "--quiet", *arguments[1:]]
    if subprocess.run(command, check=False, stdout=sys.stderr).returncode != 0:
        fix = "pip could not install it (see its output above); check that a package index is reachable."
        raise MissingDependencyError(f"LeRobot's environment ({' '.join(arguments)})", fix=fix)


def _unpack_lerobot(python: Path, lerobot: str, packages_folder: Path) -> None:
    """Unpack LeRobot's wheel, whose declared Python version pip would refuse, and translate its newer syntax."""
    with tempfile.TemporaryDirectory() as temporary:
        _pip(python, "download", "--no-deps", "--ignore-requires-python", "--dest", temporary, lerobot)
        (wheel,) = Path(temporary).glob("lerobot-*.whl")
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(packages_folder)
    for path in sorted((packages_folder / "lerobot").rglob("*.py")):
        source = path.read_text("utf-8")
        try:
            compile(source, str(path), "exec")
        except SyntaxError:
            lowered = lower_type_parameters(source)
            compile(lowered, str(path), "exec")
            path.write_text(lowered, "utf-8")
            print(f"translated: {path.relative_to(packages_folder)}", file=sys.stderr)


def _declare_operators(packages_folder: Path) -> None:
    """Let torchvision import the declarations of its operators first."""
    shutil.copy(OPERATORS, packages_folder / OPERATORS.name)
    start = packages_folder / "torchvision" / "__init__.py"
    start.write_text(f"import {OPERATORS.stem}\n{start.read_text('utf-8')}", "utf-8")


if __name__ == "__main__":
    try:
        create()
    except MissingDependencyError as missing:
        sys.exit(str(missing))
