"""All or nothing in an SQLite file: one transaction that holds the write lock from its first statement."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator, Iterator
from contextlib import contextmanager


@contextmanager
def transaction(database: sqlite3.Connection) -> Generator[None]:
    """What is done inside is written when the block ends, or nothing of it if the block raises.

    `database` is a connection with `isolation_level=None`. The write lock is taken at the beginning (BEGIN IMMEDIATE),
    so two writers meet there and not half-way. Raises what SQLite raises. Promise: a process killed inside leaves the
    file as it was before, where the disk keeps what it says it has synced.
    """
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:  # a full disk has already rolled back
            database.execute("ROLLBACK")
        raise


def split_statements(script: str) -> Iterator[str]:
    """The statements of `script` one by one, each ending its line; `executescript` would end a transaction."""
    begun = ""
    for line in script.splitlines(keepends=True):
        begun += line
        if sqlite3.complete_statement(begun):
            yield begun
            begun = ""
