"""The program `dualbrain`, and `python -m dualbrain`: `--version` always works, the commands need the extra `cli`."""

from __future__ import annotations

import os
import sys

from dualbrain import __version__
from dualbrain.cli.common.exit_codes import ExitCode

CLI_PACKAGES = ("cyclopts", "rich")
"""Modules that the extra `cli` installs."""
INSTALL_HINT = (
    "dualbrain: the command line is not installed, only the library (gate and safety filter). Install it with "
    "`pip install 'dualbrain[cli]'`, or `pip install 'dualbrain[all]'` for simulation, planner and memory too."
)


def main() -> None:
    """Run the command line and exit with its exit code; without the extra `cli`, name it and exit with 2."""
    open_closed_streams()
    sys.exit(run_program(sys.argv[1:]))


def open_closed_streams() -> None:
    """Open the null device in place of each standard stream that the caller closed (`dualbrain … <&-`).

    Otherwise the first file that is opened, such as a recording, has the number of a standard stream, and libraries
    write their messages into it.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  (until the process ends)


def run_program(arguments: list[str]) -> int:
    """The exit code of `dualbrain` called with `arguments`."""
    if arguments == ["--version"]:
        _print_version()
        return ExitCode.SUCCESS
    try:
        from dualbrain.cli.main import run_command_line  # noqa: PLC0415 (only if the extra is installed)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in CLI_PACKAGES:
            raise
        print(INSTALL_HINT, file=sys.stderr)  # noqa: T201
        return ExitCode.USAGE
    except KeyboardInterrupt:  # during the imports; `run_command_line` catches those of the command
        print("dualbrain: interrupted", file=sys.stderr)  # noqa: T201
        return ExitCode.INTERRUPTED
    return run_command_line(arguments)


def _print_version() -> None:
    """Print the version; a closed pipe gets none."""
    try:
        print(__version__, flush=True)  # noqa: T201
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at the end of the process


if __name__ == "__main__":
    main()
