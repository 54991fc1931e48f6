"""The running gatekeepers of this user: from their registrations, and from the list of processes for all others."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.registration import (
    REGISTRATIONS,
    Registration,
    process_start_ticks,
    read_registrations,
)
from dualbrain.core.paths import default_home
from dualbrain.errors import DualbrainError

SPAWNED_MODULE = "dualbrain.control.gatekeeper.process"
"""Module of a gatekeeper that a program started; robot and socket follow it on the command line."""
STARTED_BY_PERSON = "a person with `dualbrain gatekeeper`"
STATUS_TIMEOUT_S = 1.0
"""Longest wait for a status report [s]."""
SETTLING_TIME_S = 3.0
"""Time [s] in which a gatekeeper that is starting begins to answer, and one that is shutting down has ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningGatekeeper:
    """One running gatekeeper.

    `since`: local time of its start, `started_by`: the command or program that started it, `parent`: the process that
    started it. `commander`: whether a commander is connected, None if it does not answer (`problem`).
    """

    pid: int
    robot: str
    socket: Path
    keys: Path | None
    since: datetime | None
    started_by: str
    parent: int
    commander: bool | None
    problem: str = ""

    def __str__(self) -> str:
        """One line: robot, socket, start, commander, and how to end it."""
        since = f"since {self.since:%Y-%m-%d %H:%M:%S}" if self.since else "start unknown"
        commander = {True: "commander connected", False: "no commander", None: self.problem}[self.commander]
        return (
            f"robot {self.robot}, socket {self.socket}, {since}, started by {self.started_by} (process {self.parent}), "
            f"{commander}. {self.ending}"
        )

    @property
    def ending(self) -> str:
        """How to end it; it brakes the arm first."""
        if self.commander is None or self.keys is None:
            return f"End it: kill {self.pid}"
        where = f"--socket {shlex.quote(str(self.socket))} --keys {shlex.quote(str(self.keys))}"
        return f"End it: dualbrain operate shut_down {where}, or kill {self.pid}"


def running_gatekeepers(home: Path) -> list[RunningGatekeeper]:
    """All running gatekeepers of this user, registered in the data folder `home` or found in /proc, by process number.

    Each is asked for its status over its socket, as an observer, which changes nothing. One that does not answer, and
    still runs after `SETTLING_TIME_S`, has a problem; one that has ended by then is left out.
    """
    return [examined for one in find_gatekeepers(home) if (examined := _examine_settled(one)) is not None]


def find_gatekeepers(home: Path) -> list[Registration]:
    """All gatekeepers as `running_gatekeepers` finds them, without a question to any."""
    found = {one.pid: one for one in _from_process_list()}
    found |= {one.pid: one for one in read_registrations(home / REGISTRATIONS)}
    return [one for pid, one in sorted(found.items()) if not _is_part_of(found.get(_parent(pid)), one)]


def running_sockets(home: Path) -> list[Path]:
    """The sockets of `find_gatekeepers`, each once."""
    return list(dict.fromkeys(Path(one.socket) for one in find_gatekeepers(home)))


def _is_part_of(parent: Registration | None, one: Registration) -> bool:
    """Whether `one` is a process that a gatekeeper forked: it has the command line of its parent."""
    return parent is not None and parent.socket == one.socket


def _examine_settled(one: Registration) -> RunningGatekeeper | None:
    """The gatekeeper `one` once it answers, or after `SETTLING_TIME_S`; None if it has ended."""
    deadline = time.monotonic() + SETTLING_TIME_S
    examined = _examine(one)
    while examined.commander is None:
        if not one.is_running:
            return None
        if time.monotonic() > deadline:
            break
        time.sleep(0.05)
        examined = _examine(one)
    return examined


def _examine(one: Registration) -> RunningGatekeeper:
    commander, problem = _ask_for_commander(Path(one.socket))
    return RunningGatekeeper(
        pid=one.pid,
        robot=one.robot,
        socket=Path(one.socket),
        keys=Path(one.keys) if one.keys else None,
        since=_start_time(one.pid),
        started_by=one.started_by,
        parent=_parent(one.pid),
        commander=commander,
        problem=problem,
    )


def _ask_for_commander(socket: Path) -> tuple[bool | None, str]:
    """Whether a commander is connected; None and the reason if the gatekeeper does not answer."""
    try:
        client = GatekeeperClient(socket)
    except (DualbrainError, OSError) as error:
        return None, f"it does not answer: {str(error).split(': ')[-1].rstrip('.')}"
    try:
        deadline = time.monotonic() + STATUS_TIMEOUT_S
        while client.status is None and time.monotonic() < deadline:
            time.sleep(0.01)
        status = client.status
    finally:
        client.close()
    return (None, "it sends no status") if status is None else (status.commander, "")


# --- the list of processes ------------------------------------------------------------------------------------------


def _from_process_list() -> Iterator[Registration]:
    """Gatekeepers among the processes of this user, by their command lines; nothing where there is no /proc."""
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError):
            if entry.stat().st_uid != os.getuid():
                continue
            arguments = (entry / "cmdline").read_bytes().decode("utf-8", "surrogateescape").split("\0")[:-1]
            pid = int(entry.name)
            if (one := _spawned(pid, arguments) or _started_by_person(pid, arguments)) and one.is_running:
                yield one


def _spawned(pid: int, arguments: list[str]) -> Registration | None:
    """`python -m dualbrain.core.processes.parent_pipe PARENT dualbrain.control.gatekeeper.process ROBOT SOCKET`."""
    if SPAWNED_MODULE not in arguments[3:] or len(arguments) < arguments.index(SPAWNED_MODULE) + 3:
        return None
    at = arguments.index(SPAWNED_MODULE)
    keys = Path(arguments[at + 2]).with_name("keys")
    return _registration(pid, arguments[at + 1], arguments[at + 2], str(keys) if keys.exists() else "", "a program")


def _started_by_person(pid: int, arguments: list[str]) -> Registration | None:
    """`python -m dualbrain gatekeeper …` or `python …/dualbrain gatekeeper …`, with the defaults of its environment."""
    if "gatekeeper" not in arguments[:6]:
        return None
    at = arguments.index("gatekeeper")
    if at == 0 or Path(arguments[at - 1]).name not in ("dualbrain", "__main__.py"):
        return None
    options, folder = _options(arguments[at + 1 :]), Path(f"/proc/{pid}/cwd").readlink()
    home = folder / _home(pid)
    socket, keys = (
        str(folder / options[name]) if name in options else str(home / default)
        for name, default in (("socket", "gatekeeper.sock"), ("keys", "keys"))
    )
    return _registration(pid, options.get("robot", "panda"), socket, keys, STARTED_BY_PERSON)


def _registration(pid: int, robot: str, socket: str, keys: str, started_by: str) -> Registration:
    return Registration(
        pid=pid, start_ticks=process_start_ticks(pid), robot=robot, socket=socket, keys=keys, started_by=started_by
    )


def _options(arguments: list[str]) -> dict[str, str]:
    """Values of `--name value` and `--name=value`."""
    found: dict[str, str] = {}
    for index, argument in enumerate(arguments):
        if argument.startswith("--"):
            name, equals, value = argument[2:].partition("=")
            found[name] = value if equals else next(iter(arguments[index + 1 : index + 2]), "")
    return found


def _home(pid: int) -> Path:
    """The data folder of dualbrain in the environment of a process (see `dualbrain.core.paths`)."""
    lines = Path(f"/proc/{pid}/environ").read_bytes().decode("utf-8", "surrogateescape").split("\0")
    parts = (line.partition("=") for line in lines)
    return default_home({name: value for name, _, value in parts})


def _start_time(pid: int) -> datetime | None:
    """Local time at which a process started."""
    ticks = process_start_ticks(pid)
    if ticks is None:
        return None
    age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    return datetime.fromtimestamp(time.time() - age).astimezone()


def _parent(pid: int) -> int:
    """Process number of the parent, 0 if it is unknown."""
    with suppress(OSError, ValueError):
        return int(Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[1])
    return 0
