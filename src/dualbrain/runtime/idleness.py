"""Whether now is a time to learn: a robot that rests, a machine with little to do, no battery that runs down.

Looking disturbs nobody: no lock is taken and no socket is opened, for a robot that starts at that moment must find both
free.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dualbrain.memory.writer_lock import holder_of

UNIX_SOCKETS, POWER = Path("/proc/net/unix"), Path("/sys/class/power_supply")
QUIET, CROWDED = 0.5, 0.75
"""Load a processor: below the first, learning begins; what others add must stay below the second while it goes on."""


@dataclass(frozen=True, slots=True)
class Machine:
    """How busy it is: `load` (processes that run or wait, mean of a minute), `processors`, running `on_battery`."""

    load: float
    processors: int
    on_battery: bool


def look(power: Path = POWER) -> Machine:
    """The machine as it is now; one without batteries in sight is not on battery."""
    states = [path.read_text().strip() for path in power.glob("*/status")] if power.is_dir() else []
    return Machine(os.getloadavg()[0], os.cpu_count() or 1, "Discharging" in states)


def robot_at_work(ledger: Path, sockets: Sequence[Path], *, own: int | None = None) -> str:
    """Why the robot counts as working, "" if it rests; `own` is a process that does not count.

    A session holds its ledger's writer lock from before it moves until all is recorded; a gatekeeper listens at its
    socket as long as it holds a robot.
    """
    holder = holder_of(ledger)
    if holder is not None and holder.pid != own:
        return f"{holder.name} (process {holder.pid})"
    listening = UNIX_SOCKETS.read_text("utf-8", "replace").split() if UNIX_SOCKETS.is_file() else []
    return next((f"a gatekeeper at {path}" for path in sockets if str(path.absolute()) in listening), "")


def why_not_now(machine: Machine, at_work: str, *, own_threads: int = 0) -> str:
    """What speaks against learning now, "" if nothing does; `own_threads` of the load are learning's own.

    0 threads: it has not begun, and wants a quiet machine.
    """
    if at_work:
        return at_work
    if machine.on_battery:
        return "the battery runs down"
    others = max(machine.load - own_threads, 0.0) / machine.processors
    if others > (CROWDED if own_threads else QUIET):
        return f"the machine is busy (load {machine.load:.1f} on {machine.processors} processors)"
    return ""
