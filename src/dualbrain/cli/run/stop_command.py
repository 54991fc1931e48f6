"""Stop commands in words: to all running robots of this user, and on standard input during a run."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TextIO


def stop_running_robots(home: Path) -> list[str]:
    """Abort the contracts of all running gatekeepers of this user; one line per gatekeeper.

    They are registered in the data folder `home`, or found in the list of processes. The arm of each of them brakes to
    rest. Nothing is started, and no planner is asked.
    """
    from dualbrain.cli.common.running_gatekeepers import find_gatekeepers
    from dualbrain.control.gatekeeper.protocol.authentication import read_keys
    from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
    from dualbrain.errors import DualbrainError

    lines: list[str] = []
    for one in find_gatekeepers(home):
        try:
            link = GatekeeperClient(Path(one.socket), read_keys(Path(one.keys), ("operator",)), "operator")
            try:
                link.operate("abort")
            finally:
                link.close()
        except (DualbrainError, OSError) as error:
            lines.append(f"robot {one.robot}, socket {one.socket}: not stopped: {error}")
        else:
            lines.append(f"robot {one.robot}, socket {one.socket}: stopped")
    return lines


def listen_for_stop(instruct: Callable[[str], bool], answer: Callable[[str], None], stream: TextIO = sys.stdin) -> None:
    """Pass every line of `stream` to `instruct` on a thread of its own, until the stream or the process ends.

    `instruct` returns whether the line is a stop command; `answer` gets a message for any other line. Nothing is
    read unless `stream` is a terminal.
    """
    if not stream.isatty():
        return
    Thread(target=_read_lines, args=(instruct, answer, stream), name="stop commands", daemon=True).start()


def _read_lines(instruct: Callable[[str], bool], answer: Callable[[str], None], stream: TextIO) -> None:
    with suppress(OSError, ValueError):  # the stream was closed
        for line in stream:
            if line.strip() and not instruct(line):
                answer("An instruction is being carried out. During it, only stop commands such as 'stop' are read.")
