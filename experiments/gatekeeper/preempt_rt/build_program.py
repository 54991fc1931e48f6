"""Build of the program of this experiment: control thread, robot and load in one static executable."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import msgspec

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.target.build import KERNEL_FLAGS, source_root
from dualbrain.safety.target.robot_tables import render_robot_tables
from experiments.gatekeeper.preempt_rt.c_inputs import render_run_inputs

PROGRAM = Path(__file__).with_name("program")
"""Folder of the program's own sources."""
BUILD_TIMEOUT_S = 300.0
"""Longest time of a build [s]."""


def build_program(folder: Path, *, optimisation: str = "-O3") -> Path:
    """Build the program for a Panda without force sensing in `folder`; returns the path of the executable.

    Raises:
        MissingDependencyError: gcc is not installed.
        ConfigurationError: gcc reported an error.
    """
    if shutil.which("gcc") is None:
        raise MissingDependencyError("The compiler gcc", fix="On Debian: apt-get install build-essential")
    robot_model = msgspec.structs.replace(load_robot("panda"), force_sensing=None)
    tables, inputs, program = folder / "robot_tables.c", folder / "run_inputs.c", folder / "control_thread_run"
    tables.write_text(render_robot_tables(robot_model, FilterConfig()), "utf-8")
    inputs.write_text(render_run_inputs(robot_model), "utf-8")
    command = [*_command(optimisation), str(tables), str(inputs), "-lm", "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=BUILD_TIMEOUT_S)
    if done.returncode != 0:
        fix = f"The compiler reported:\n{done.stderr[-2000:]}"
        raise ConfigurationError.stating("The program of the experiment could not be built.", fix=fix)
    return program


def _command(optimisation: str) -> list[str]:
    """The compiler with the flags of the kernel; warnings are errors."""
    kernel = source_root() / "kernel"
    folders = (kernel / "src", kernel / "supervisor", kernel / "realtime", PROGRAM)
    includes = (kernel / "include", kernel / "src", kernel / "realtime", PROGRAM)
    return [
        "gcc",
        "-std=c99",
        optimisation,
        *KERNEL_FLAGS,
        "-Wall",
        "-Wextra",
        "-Werror",
        "-Wno-maybe-uninitialized",
        "-static",
        "-pthread",
        *(f"-I{one}" for one in includes),
        *sorted(str(path) for one in folders for path in one.rglob("*.c")),
    ]
