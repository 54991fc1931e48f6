"""`dualbrain adapt --when-idle`: training in a process of its own while robot and machine are idle."""

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
    remaining_load,
    robot_activity,
)
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.running_gatekeepers import running_sockets
from dualbrain.cli.common.signals import interrupt_handler
from dualbrain.cli.memory.open_memory import ledger_path
from dualbrain.core.paths import dualbrain_home


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
    """Train in `out` whenever robot and machine are idle; returns when the training has ended by itself.

    Raises `KeyboardInterrupt` on Ctrl-C and on SIGTERM. The training ends with this process, even if that is killed.
    """
    threads, ledger_file = _trainer_threads(config), ledger_path(ledger)
    preexec = kill_on_parent_exit(os.getpid())

    def start() -> subprocess.Popen[bytes]:
        command = adapt_command(robot, base, ledger, site, config, out, json=json)
        return subprocess.Popen(command, start_new_session=True, preexec_fn=preexec)  # noqa: PLW1509  (no other thread)

    def get_blocking_reason(own_pid: int | None) -> str:
        home = dualbrain_home()
        default = (home / "gatekeeper.sock",)
        activity = robot_activity(ledger_file, default, running=running_sockets(home), own_pid=own_pid)
        own_load = remaining_load(threads, scheduler.halted_time) if own_pid is not None else 0.0
        return blocking_reason(read_machine_load(), activity, own_load=own_load)

    scheduler = IdleScheduler(
        start, get_blocking_reason, StderrConsole().print, clock=time.monotonic, sleep=time.sleep, config=pace
    )
    with interrupt_handler(_raise_interrupt):
        code = scheduler.run()
    if code < 0:
        StderrConsole().print(
            f"the training was ended by signal {-code} ({signal.strsignal(-code)}); the same command with --out {out} "
            f"resumes from the last checkpoint",
            markup=False,
        )
    return ExitCode(code) if code in set(ExitCode) else ExitCode.SETUP


def _raise_interrupt() -> None:
    raise KeyboardInterrupt


def adapt_command(
    robot: str, base: str, ledger: Path | None, site: Path | None, config: Path | None, out: Path, *, json: bool
) -> list[str]:
    """The command line of the same training without waiting; with its --out it resumes the run."""
    options: dict[str, Path | str | None] = {
        "--robot": robot,
        "--base": base,
        "--ledger": ledger,
        "--site": site,
        "--config": config,
        "--out": out,
    }
    arguments = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    code = "import sys; from dualbrain.__main__ import main; sys.exit(main())"
    return [sys.executable, "-c", code, "adapt", *arguments, *(["--json"] if json else [])]


def _trainer_threads(config: Path | None) -> int:
    """Number of processor threads of the training."""
    from dualbrain.adaptation.config import AdaptConfig, read_config

    return (read_config(config) if config else AdaptConfig()).fit.threads or 1
