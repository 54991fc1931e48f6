"""dualbrain shell: give one instruction after another, with the planner, the memory and the scene kept open."""

from __future__ import annotations

import signal
import sys
from collections import deque
from pathlib import Path
from types import FrameType
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from dualbrain.cli.common.arguments import Port, Seed, parse_fraction
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.run import DEFAULT_TRIES, MAX_TRIES
from dualbrain.cli.run.shell.commands import QUIT_WORDS, SHELL_COMMANDS
from dualbrain.cli.run.shell.line_reader import LineReader
from dualbrain.cli.run.shell.options import HistoryEntry, ShellOptions
from dualbrain.cli.run.shell.worker import InstructionWorker
from dualbrain.errors import UsageError


def shell(
    *,
    robot: str = "panda",
    scene: str = "0",
    after: Path | None = None,
    planner: str = "",
    site: Path | None = None,
    headless: bool = False,
    out: Path = Path("runs"),
    ledger: Path | None = None,
    seed: Seed = 0,
    tries: int = DEFAULT_TRIES,
    port: Port = 8080,
    knowledge: Literal["on", "site", "off"] = "site",
    reuse_contracts: Annotated[bool, Parameter(negative="")] = False,
    live: Annotated[bool, Parameter(negative="")] = False,
    speed: str = "100%",
) -> int:
    """Give instructions one after another; objects stay where they were put, and the planner stays loaded.

    Every instruction is a run as of `dualbrain run`, with its own run folder, and begins where the one before ended.
    `help` lists the commands. `stop` and Ctrl-C stop the motion at any time, `quit` and Ctrl-D leave. Without a
    terminal, the lines of standard input are carried out in their order; only a stop command is never delayed.

    Exit code 0 if every instruction was carried out, else the exit code of the last one that was not.

    Parameters
    ----------
    robot
        panda, fr3, ur5e, base or mobile_panda.
    scene
        A number, FAMILY:SEED or a scene file; see `dualbrain scenes`.
    after
        Folder of an earlier simulated run of this robot: begin where it ended, instead of --scene.
    planner
        As for `dualbrain run`.
    site
        Site file (TOML), as for `dualbrain run`.
    headless
        Do not open the live view, in which instructions can be entered too.
    out
        Folder in which each instruction gets a run folder.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    seed
        Seed of the perception noise.
    tries
        Number of contracts that may be executed for one instruction, 1 to 5.
    port
        Port of the live view, on the loopback interface.
    knowledge
        "site", "on" or "off": documents whose passages enter the prompt, as for `dualbrain run`.
    reuse_contracts
        Reuse a contract that succeeded in this place instead of asking the planner, as for `dualbrain run`.
    live
        Carry out each instruction in real time behind a gatekeeper process. Between instructions no process moves the
        robot, and its brakes are on.
    speed
        With --live: initial speed scale, as 10% or 0.1.
    """
    if not 1 <= tries <= MAX_TRIES:
        raise UsageError("--tries", got=tries, allowed=f"1 to {MAX_TRIES}")
    speed_scale = parse_fraction(speed)
    if speed_scale != 1.0 and not live:
        raise UsageError.stating(
            "--speed scales only a robot in real time behind a gatekeeper.", fix="Add --live, or leave out --speed."
        )
    options = ShellOptions(
        robot=robot,
        scene=scene,
        after=after,
        planner=planner,
        site=site,
        out=out,
        ledger=ledger,
        seed=seed,
        tries=tries,
        consult=knowledge,
        reuse_contracts=reuse_contracts,
        live_view=not headless,
        port=port,
        real_time=live,
        speed_scale=speed_scale,
    )
    return Shell(options, StderrConsole()).run()


class Shell:
    """The main thread of the shell: it reads lines and signals, and never waits for an instruction."""

    def __init__(self, options: ShellOptions, console: Console) -> None:
        """Print the title, and begin to load in the background."""
        where = f"continues {options.after}" if options.after else f"scene {options.scene}"
        console.print(f"[bold]dualbrain shell[/]  [dim]{escape(options.robot)}, {escape(where)}[/]")
        console.print("Type an instruction, or `help`. Ctrl-C stops the motion, `quit` leaves.", markup=False)
        self.options, self.console = options, console
        self._reader = LineReader()
        self.worker = InstructionWorker(options, console, self._reader.wake)
        self._waiting: deque[tuple[str, int]] = deque()
        """Lines that wait, each with the number of stops before it."""
        self._leaving = False

    def run(self) -> int:
        """Read lines until the shell is left; returns the exit code."""
        previous = {one: signal.signal(one, self._on_signal) for one in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._reader.show_prompt()
            while self.worker.busy or not self._has_ended():
                self._step()
            if self.worker.failure is not None:
                raise self.worker.failure
        finally:
            for one, handler in previous.items():
                signal.signal(one, handler)
            self.worker.interrupt()
            self.worker.close()
            self._reader.close()
        return next((entry.code for entry in reversed(self.worker.history) if entry.code), ExitCode.SUCCESS)

    def _has_ended(self) -> bool:
        left = self._leaving or (self._reader.ended and not self._waiting)
        return left or self.worker.failure is not None

    def _step(self) -> None:
        """Carry out one line, or wait until there is one."""
        try:
            if self.worker.busy:
                self._read_while_busy()
            elif self._waiting:
                self._carry_out_waiting(*self._waiting.popleft())
            elif (line := self._reader.prompt()) is None:
                self._leaving = True
            else:
                self._carry_out(line)
        except KeyboardInterrupt:  # while nothing moves
            self.console.print("\nNothing moves. `quit` or Ctrl-D leaves.", markup=False)

    def _read_while_busy(self) -> None:
        """Read a line while an instruction is carried out: a stop command acts at once."""
        line = self._reader.wait()
        if line is None:
            if self._reader.ended and self._reader.is_terminal:
                self._leave()
        elif self._reader.is_terminal and line.strip().lower() in QUIT_WORDS:
            self._leave()
        elif self._stops(line):
            self._stop()
        elif not self._moves():
            self._waiting.append((line, self.worker.stops))
        elif self._reader.is_terminal and line.strip():
            self.console.print("[yellow]An instruction is being carried out. Only `stop` and `quit` are read.[/]")
        else:
            self._waiting.append((line, self.worker.stops))

    def _carry_out_waiting(self, line: str, stops: int) -> None:
        """Carry out a line that waited, unless a person stopped the robot meanwhile."""
        if stops == self.worker.stops or line.strip().lower() in QUIT_WORDS:
            self._carry_out(line)
            return
        self.console.print(f"discarded, because a stop followed: {line}", markup=False)
        if (words := line.strip()) and words.lower() not in SHELL_COMMANDS:
            entry = HistoryEntry(
                instruction=words, outcome="discarded: a stop followed", code=ExitCode.INTERRUPTED, folder=None
            )
            self.worker.history.append(entry)

    def _carry_out(self, line: str) -> None:
        """A command of the shell, or an instruction."""
        words = line.strip()
        if not words:
            return
        if words.lower() in QUIT_WORDS:
            self._leave()
        elif command := SHELL_COMMANDS.get(words.lower()):
            command(self)
        elif self._stops(words):
            self._stop()
        elif reason := self.worker.submit(words):
            self.console.print(f"[yellow]{escape(reason)}[/]")

    def _moves(self) -> bool:
        """Whether an instruction is being carried out."""
        return self.worker.busy and not self.worker.loading

    def _stops(self, line: str) -> bool:
        """Whether a line is a stop command, or asks a moving robot to stop if a person types it. `quit` is none."""
        from dualbrain.grounding.instruction.stop_commands import asks_to_stop, is_stop_command

        words = line.strip(" \t!.").lower()
        is_for_moving_robot = self._moves() and self._reader.is_terminal
        if words == "help":
            return is_for_moving_robot
        return words not in QUIT_WORDS and (asks_to_stop(line) if is_for_moving_robot else is_stop_command(line))

    def _stop(self) -> None:
        """Stop the present instruction; without one, stop every running gatekeeper of this user."""
        moves = self._moves()
        self.worker.interrupt()
        if moves:
            self.console.print("[yellow]stopping: the arm brakes to rest[/]")
            return
        from dualbrain.cli.run.stop_command import stop_running_robots
        from dualbrain.core.paths import dualbrain_home

        for text in stop_running_robots(dualbrain_home()) or ["Nothing moves."]:
            self.console.print(text, markup=False)

    def _leave(self) -> None:
        self._leaving = True
        self.worker.interrupt()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        """Ctrl-C stops the motion and not the shell; SIGTERM stops it and leaves."""
        del frame
        if number == signal.SIGTERM:
            self._leave()
            if not self.worker.busy:
                sys.exit(ExitCode.INTERRUPTED)
        elif self._moves():
            self.worker.interrupt()
            self.console.print("[yellow]stopping: the arm brakes to rest[/]")
        else:
            self.worker.interrupt()
            raise KeyboardInterrupt
