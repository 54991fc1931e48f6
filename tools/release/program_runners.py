"""Runs the program from a wheel as the users of uv and pipx do, without an installation."""

from __future__ import annotations

from pathlib import Path

import dualbrain
from tools.release.environments import Environment, run_program


class WrongVersionError(Exception):
    """A runner that printed another version than that of the checkout."""


def check_runners(wheel: Path, interpreter: Path, folder: Path, tools: Environment) -> tuple[str, ...]:
    """The commands that printed the version of the wheel; each has a folder of its own for its environments.

    Raises `ProgramError`, and `WrongVersionError` if another version is printed.
    """
    with_commands = f"dualbrain[cli] @ {wheel.resolve().as_uri()}"
    settings = {"UV_TOOL_DIR": str(folder / "uv"), "PIPX_HOME": str(folder / "pipx"), "PIP_CONSTRAINT": ""}
    uv = [tools.program("uv"), "tool", "run", "--python", interpreter]
    pipx = [tools.program("pipx"), "run", "--python", interpreter, "--no-cache"]
    for command in (
        [*uv, "--from", wheel, "dualbrain", "--version"],
        [*uv, "--from", with_commands, "dualbrain", "--version"],
        [*pipx, "--spec", wheel, "dualbrain", "--version"],
    ):
        printed = run_program(command, cwd=folder, settings=settings).strip()
        if printed != dualbrain.__version__:
            raise WrongVersionError(f"{command} printed {printed!r}, expected {dualbrain.__version__!r}")
    run_program([*uv, "--from", with_commands, "dualbrain", "schema"], cwd=folder, settings=settings)
    return "uv tool run --from WHEEL dualbrain --version", "pipx run --spec WHEEL dualbrain --version"
