"""SQLite transactions that take the write lock at their beginning, and a splitter of SQL scripts into statements."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager


@contextmanager
def transaction(database: sqlite3.Connection) -> Generator[None]:
    """One transaction: committed when the block ends, rolled back if the block raises an exception.

    `database` is a connection with `isolation_level=None`. The write lock is taken at the beginning (BEGIN IMMEDIATE),
    so a second writer waits or fails there and not in the middle of its work. Raises the exceptions of SQLite. Promise:
    a process killed inside the block leaves the file unchanged, provided that the disk keeps the data it reports as
    synced.
    """
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:  # a full disk has already rolled back
            database.execute("ROLLBACK")
        raise


def harden(database: sqlite3.Connection) -> None:
    """Let the file behind `database` run as little as possible: a changed file may contain its own views and functions.

    The schema may call no function with side effects, no extension can be loaded, and the internal tables of SQLite
    cannot be written. Call it before the first statement that reads a table.
    """
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA cell_size_check = ON")
    if hasattr(database, "enable_load_extension"):  # absent if Python was built without extensions
        database.enable_load_extension(False)
    if sys.version_info >= (3, 12):
        database.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)


def split_statements(script: str) -> Iterator[str]:
    """The statements of `script`, each of which ends at the end of a line.

    `sqlite3.Connection.executescript` cannot be used inside a transaction, because it commits first.
    """
    statement = ""
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""
