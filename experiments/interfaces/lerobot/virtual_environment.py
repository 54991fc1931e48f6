"""LeRobot's virtual environment, build/lerobot/venv, created from requirements.txt.

Run: python -m experiments.interfaces.lerobot.virtual_environment

It installs LeRobot 0.6.1 with a CPU torch (1.6 GB on disk), without dualbrain, whose sources the tests put on the path.
LeRobot is fetched by name without its dependencies and unpacked; files in the syntax of Python 3.12 are translated
(`type_parameter_syntax`), and torchvision gets the declarations of `torchvision_operators`.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path

from experiments.engine.virtual_environment import BUILD, VirtualEnvironment, run_creation
from experiments.interfaces.lerobot.type_parameter_syntax import lower_type_parameters

HERE = Path(__file__).resolve().parent
OPERATORS = HERE / "torchvision_operators.py"
ENVIRONMENT = VirtualEnvironment(
    title="LeRobot",
    folder=BUILD / "lerobot",
    command="python -m experiments.interfaces.lerobot.virtual_environment",
    sources=(HERE / "requirements.txt", OPERATORS, HERE / "type_parameter_syntax.py"),
)
SOURCE_PACKAGE = "feetech-servo-sdk"
"""The package that has no wheel."""
VARIABLES = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "OMP_NUM_THREADS": "1", "TOKENIZERS_PARALLELISM": "0"}
"""Variables of every process of the environment: it must not ask a server for a dataset."""


def process_environment(folder: Path) -> dict[str, str]:
    """The variables of a process of the environment, whose caches are in `folder`."""
    return {**os.environ, **VARIABLES, "HF_HOME": str(folder)}


def create() -> Path:
    """Create the environment if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    return ENVIRONMENT.create(_install)


def _install() -> None:
    packages = ENVIRONMENT.packages
    lerobot, vision = (next(one for one in packages if one.startswith(name)) for name in ("lerobot==", "torchvision=="))
    others = (one for one in packages if one not in (lerobot, vision))
    ENVIRONMENT.pip("install", "--only-binary", ":all:", "--no-binary", SOURCE_PACKAGE, *others)
    ENVIRONMENT.pip("install", "--no-deps", vision)  # its wheel asks for another build of torch
    (packages_folder,) = (ENVIRONMENT.folder / "venv" / "lib").glob("python3*/site-packages")
    _unpack_lerobot(lerobot, packages_folder)
    _declare_operators(packages_folder)


def _unpack_lerobot(lerobot: str, packages_folder: Path) -> None:
    """Unpack LeRobot's wheel, whose declared Python version pip would refuse, and translate its newer syntax."""
    with tempfile.TemporaryDirectory() as temporary:
        ENVIRONMENT.pip("download", "--no-deps", "--ignore-requires-python", "--dest", temporary, lerobot)
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
    run_creation(create)
