"""dualbrain adapt --when-idle: the fit as a process of its own, in the robot's and the machine's idle time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from dualbrain.adaptation.idle_scheduler import (
    IdleScheduler,
    IdleSchedulerConfig,
    blocking_reason,
    kill_on_parent_exit,
    read_machine_load,
    robot_activity,
)
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import dualbrain_home
from dualbrain.cli.common.signals import interrupt_handler
from dualbrain.cli.memory.open_memory import ledger_path


def adapt_when_idle(
    *,
    robot: str,
    base: str,
    ledger: Path | None,
    site: Path | None,
    config: Path | None,
    out: Path,
    json: bool,
    pace: IdleSchedulerConfig | None = None,
) -> int:
    """Fit in `out` whenever nothing speaks against it; returns when the fit has ended by itself.

    Raises `KeyboardInterrupt` on Ctrl-C and on SIGTERM; then the fit is ended, and if this is killed it ends, too.
    """
    threads, where = _trainer_threads(config), ledger_path(ledger)
    bound = kill_on_parent_exit(os.getpid())

    def start() -> subprocess.Popen[bytes]:
        words = adapt_command(robot, base, ledger, site, config, out, json=json)
        return subprocess.Popen(words, start_new_session=True, preexec_fn=bound)  # noqa: PLW1509  (no other thread here)

    def why_not(own: int | None) -> str:
        at_work = robot_activity(where, (dualbrain_home() / "gatekeeper.sock",), own_pid=own)
        return blocking_reason(read_machine_load(), at_work, own_threads=threads if own is not None else 0)

    with interrupt_handler(_raise_interrupt):
        code = IdleScheduler(
            start, why_not, StderrConsole().print, clock=time.monotonic, sleep=time.sleep, config=pace
        ).run()
    if code < 0:
        StderrConsole().print(
            f"the fit was ended by signal {-code} ({signal.strsignal(-code)}); the same command with --out {out} goes "
            f"on from the last checkpoint"
        )
    return ExitCode(code) if code in set(ExitCode) else ExitCode.SETUP


def _raise_interrupt() -> None:
    raise KeyboardInterrupt


def adapt_command(
    robot: str, base: str, ledger: Path | None, site: Path | None, config: Path | None, out: Path, *, json: bool
) -> list[str]:
    """The same command without waiting; with its --out it goes on where it was."""
    told: dict[str, Path | str | None] = {
        "--robot": robot,
        "--base": base,
        "--ledger": ledger,
        "--site": site,
        "--config": config,
        "--out": out,
    }
    words = [word for name, value in told.items() if value is not None for word in (name, str(value))]
    code = "import sys; from dualbrain.cli.main import main; sys.exit(main())"
    return [sys.executable, "-c", code, "adapt", *words, *(["--json"] if json else [])]


def _trainer_threads(config: Path | None) -> int:
    """Processor threads of the fit."""
    from dualbrain.adaptation.config import AdaptConfig, read_config

    return (read_config(config) if config else AdaptConfig()).fit.threads or 1
