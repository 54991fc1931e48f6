"""An emulated board: QEMU as a child process, with the firmware and its link."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from dualbrain.errors import ConfigurationError
from dualbrain.safety.target.boards import Board
from dualbrain.safety.target.link import Link, MailboxLink, PipeLink

START_TIMEOUT_S = 20.0
"""Longest time until the firmware reports its start [s]."""


def _killed_with_parent() -> list[str]:
    """Words before a command that let the kernel kill it when the thread that starts it ends, also by `kill -9`.

    Empty where the program setpriv (util-linux) is missing; a lost emulator then remains.
    """
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL"] if setpriv else []


class EmulatedBoard:
    """A running emulator; `link` is the link to its firmware. Use it as a context manager."""

    def __init__(self, board: Board, elf: Path, *, link: str = "mailbox") -> None:
        """Start the emulator with the firmware `elf`; `link` is that of the build.

        Raises:
            ConfigurationError: QEMU is not installed, or the firmware does not start.
        """
        program = shutil.which("qemu-system-arm")
        if program is None:
            raise ConfigurationError.stating(
                "The emulator qemu-system-arm is not installed.", fix="On Debian: apt-get install qemu-system-arm"
            )
        command = [
            *_killed_with_parent(),
            program,
            "-nographic",
            "-monitor",
            "none",
            "-semihosting-config",
            "enable=on,target=native",
        ]
        command += ["-kernel", str(elf)]
        self._memory_file: Path | None = None
        self.link: Link = self._start_mailbox(command, board) if link == "mailbox" else self._start_uart(command, board)

    def _start_mailbox(self, command: list[str], board: Board) -> MailboxLink:
        shared = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else None
        number, name = tempfile.mkstemp(prefix="dualbrain-board-", dir=shared)
        os.close(number)
        self._memory_file = Path(name)
        link = MailboxLink(self._memory_file)
        backend = f"memory-backend-file,id=ram0,size=16M,mem-path={name},share=on"
        machine = f"{board.machine},memory-backend=ram0"
        self.process = subprocess.Popen(
            [*command, "-serial", "none", "-object", backend, "-M", machine],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + START_TIMEOUT_S
        while not link.is_ready():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.process.kill()
                self.process.wait()
                link.close()
                self._memory_file.unlink()
                raise ConfigurationError.stating(
                    f"The firmware did not start on the emulated {board.name} (exit code {self.process.returncode}).",
                    fix="Check that qemu-system-arm works: qemu-system-arm --version",
                )
            time.sleep(0.01)
        self._memory_file.unlink()
        self._memory_file = None
        return link

    def _start_uart(self, command: list[str], board: Board) -> PipeLink:
        self.process = subprocess.Popen(
            [*command, "-serial", "stdio", "-M", board.machine],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        streams = (self.process.stdin, self.process.stdout)
        link = PipeLink(*(os.dup(stream.fileno()) for stream in streams))
        for stream in streams:
            stream.close()
        return link

    def close(self) -> None:
        """End the emulator, and close the link."""
        self.process.kill()
        self.process.wait()
        self.link.close()

    def __enter__(self) -> EmulatedBoard:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
