"""A writer that is killed: by the test while it appends endlessly, or by itself before its n-th SQL statement."""

import os
import signal
import sqlite3
import sys
from pathlib import Path
from typing import Any

from dualbrain.memory.ledger.ledger import Ledger, PendingEvent, StoredVector

EVENTS_PER_TRANSACTION = 3
"""Number of events in one transaction."""


def write_steps(path: Path, run: str, steps: int) -> None:
    """Store `steps` steps (endlessly if 0) and acknowledge each on stdout after it is stored."""
    with Ledger(path, holder="the killed writer", now=1.0) as ledger:
        ledger.start_run(run, {}, now=2.0)
        step = 0
        while not steps or step < steps:
            vector = StoredVector("v", bytes(64))
            rows = [PendingEvent(kind="episode", subject=f"{run}-{step}", payload={"step": step}, vector=vector)]
            rows += [
                PendingEvent(kind="weight", subject=f"{run}-{step}", payload={"i": i})
                for i in range(EVENTS_PER_TRANSACTION - 1)
            ]
            ledger.append(rows, now=3.0)
            print(step, flush=True)  # noqa: T201 - the acknowledgement
            step += 1


def kill_before_statement(statement: int) -> None:
    """Make this process kill itself just before its SQL statement number `statement`, counted from 0."""
    connect, executed = sqlite3.connect, [0]

    def count(_: str) -> None:
        if executed[0] == statement:
            os.kill(os.getpid(), signal.SIGKILL)
        executed[0] += 1

    def connect_and_count(*args: Any, **settings: Any) -> sqlite3.Connection:
        database = connect(*args, **settings)
        database.set_trace_callback(count)
        return database

    sqlite3.connect = connect_and_count


def kill_before_each_statement(folder: Path) -> int:
    """Start children with a new ledger each that die before statement 0, 1, ...; return the first that survives."""
    statement = 0
    while True:
        child = os.fork()
        if child == 0:
            kill_before_statement(statement)
            write_steps(folder / f"{statement}.db", "run", 1)
            os._exit(0)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != -signal.SIGKILL:
            return statement
        statement += 1


if __name__ == "__main__":
    if len(sys.argv) > 2:
        write_steps(Path(sys.argv[1]), sys.argv[2], 0)
    else:
        print(kill_before_each_statement(Path(sys.argv[1])))  # noqa: T201 - the result
