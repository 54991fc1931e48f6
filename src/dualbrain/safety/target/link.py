"""Links to a target: a serial line as a pair of pipes, and a mailbox in shared memory."""

from __future__ import annotations

import mmap
import os
import select
import time
from pathlib import Path
from struct import Struct
from typing import Protocol

from dualbrain.safety.target.boards import MAILBOX_OFFSET, RAM_SIZE


class Link(Protocol):
    """A stream of bytes in both directions."""

    def write(self, data: bytes) -> None:
        """Send all bytes."""
        ...

    def read(self, timeout: float) -> bytes:
        """The bytes received until now; waits up to `timeout` [s] for the first one.

        Raises:
            OSError: the link has failed.
        """
        ...

    def close(self) -> None:
        """Close the link."""
        ...


class PipeLink:
    """The standard streams of an emulator as a serial line."""

    def __init__(self, to_target: int, to_host: int) -> None:
        """Take over two file descriptors."""
        self._to_target, self._to_host = to_target, to_host

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises:
            OSError: the emulator has ended.
        """
        while data:
            data = data[os.write(self._to_target, data) :]

    def read(self, timeout: float) -> bytes:
        """The bytes received until now.

        Raises:
            OSError: the emulator has ended.
        """
        ready, _, _ = select.select([self._to_host], [], [], timeout)
        data = os.read(self._to_host, 65536) if ready else b""
        if ready and not data:
            raise ConnectionResetError("the emulator has ended")
        return data

    def close(self) -> None:
        """Close both streams."""
        for number in (self._to_target, self._to_host):
            os.close(number)


MAGIC = 0x64626B31
_WORD = Struct("<I")
_MAGIC, _TO_TARGET_HEAD, _TO_TARGET_TAIL, _TO_HOST_HEAD, _TO_HOST_TAIL, _DRIVE, _ESTOP, _SEED = range(0, 32, 4)
RING_SIZE = 0x4000
_TO_TARGET, _TO_HOST = 0x1000, 0x1000 + RING_SIZE
SPIN_S = 0.002
"""Time of polling without a sleep [s]; a step of the filter takes less on an idle machine."""
POLL_S = 50e-6
"""Sleep between two polls afterwards [s]."""


class MailboxLink:
    """Two rings of bytes in memory that the target shares; each index is written by one side only."""

    def __init__(self, path: Path) -> None:
        """Create the shared memory in the file `path`, which the emulator maps as the RAM of its board."""
        with open(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600), "r+b") as file:
            file.truncate(RAM_SIZE)
            self._memory = mmap.mmap(file.fileno(), RAM_SIZE)
        self._words = memoryview(self._memory)[MAILBOX_OFFSET : MAILBOX_OFFSET + 32].cast("I")
        self._words[_SEED // 4] = int.from_bytes(os.urandom(4), "little")

    def is_ready(self) -> bool:
        """Whether the firmware has started."""
        return self._words[_MAGIC // 4] == MAGIC

    @property
    def drive_enabled(self) -> bool:
        """The enable output of the target."""
        return self._words[_DRIVE // 4] != 0

    def press_estop(self, *, pressed: bool) -> None:
        """Set the emergency stop input of the target."""
        self._words[_ESTOP // 4] = int(pressed)

    def write(self, data: bytes) -> None:
        """Send all bytes; waits for room.

        Raises:
            TimeoutError: the target has not read for a second.
        """
        deadline = time.monotonic() + 1.0
        while data:
            head, tail = self._words[_TO_TARGET_HEAD // 4], self._words[_TO_TARGET_TAIL // 4]
            room = RING_SIZE - (head - tail) % 2**32
            start = head % RING_SIZE
            part = data[: min(room, RING_SIZE - start)]
            if part:
                at = MAILBOX_OFFSET + _TO_TARGET + start
                self._memory[at : at + len(part)] = part
                self._words[_TO_TARGET_HEAD // 4] = (head + len(part)) % 2**32
                data = data[len(part) :]
            elif time.monotonic() > deadline:
                raise TimeoutError("the target does not read its mailbox")
            else:
                time.sleep(POLL_S)

    def read(self, timeout: float) -> bytes:
        """The bytes received until now; waits up to `timeout` [s] for the first one."""
        words, started = self._words, time.monotonic()
        while (head := words[_TO_HOST_HEAD // 4]) == (tail := words[_TO_HOST_TAIL // 4]):
            waited = time.monotonic() - started
            if waited > timeout:
                return b""
            if waited > SPIN_S:
                time.sleep(POLL_S)
        start, count = tail % RING_SIZE, (head - tail) % 2**32
        first = min(count, RING_SIZE - start)
        at = MAILBOX_OFFSET + _TO_HOST
        data = self._memory[at + start : at + start + first] + self._memory[at : at + count - first]
        words[_TO_HOST_TAIL // 4] = head
        return data

    def close(self) -> None:
        """Unmap the memory."""
        self._words.release()
        self._memory.close()
