"""A connection to a PostgreSQL server that answers every statement within a time limit, or is closed.

A server that does not answer must not stop a robot, and libpq itself waits without a limit for an answer.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import psycopg
from psycopg.conninfo import conninfo_to_dict

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.store import RefusedEntryError, ServerUnreachableError

CONNECT_TIMEOUT_S = 2
"""Longest time for a connection [s]; libpq has no shorter one."""
STATEMENT_TIMEOUT_S = 5.0
"""Longest time for one statement, including the wait for another writer [s]."""
IDLE_TIMEOUT_S = 15.0
"""The server ends a transaction of a client that is idle for this time [s], so that a dead writer blocks no other."""
_POLL_S = 0.05
_ACCESS_REFUSED = (
    psycopg.errors.InsufficientPrivilege,
    psycopg.errors.InvalidAuthorizationSpecification,
    psycopg.errors.ReadOnlySqlTransaction,
)
"""States of a server that pass: its administrator grants the access again, or makes it writable again."""
_TIMEOUT_STATES = ("25P03", "25P04")
"""SQLSTATE of a transaction that was idle or ran for too long; psycopg counts them among the internal errors."""


class ServerConnection(psycopg.Connection[tuple[Any, ...]]):
    """A connection whose statements fail after `STATEMENT_TIMEOUT_S`."""

    def wait(self, gen: Any, interval: float = _POLL_S, **more: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Run the statement `gen` of psycopg until its end or the time limit; then the connection is closed."""
        try:
            return super().wait(_limited(gen, time.monotonic() + STATEMENT_TIMEOUT_S), min(interval, _POLL_S), **more)
        except TimeoutError as error:
            self.pgconn.finish()
            raise psycopg.OperationalError(f"no answer within {STATEMENT_TIMEOUT_S:g} s") from error


def _limited(statement: Any, deadline: float) -> Generator[Any, Any, Any]:
    """The generator `statement` of psycopg, which raises `TimeoutError` if nothing arrives until `deadline`."""
    try:
        wanted = next(statement)
        while True:
            ready = yield wanted
            if not ready and time.monotonic() > deadline:
                raise TimeoutError
            wanted = statement.send(ready)
    except StopIteration as end:
        return end.value


def check_address(url: str) -> None:
    """Raise `ConfigurationError` if `url` is no address of a PostgreSQL server, or contains a password."""
    try:
        parts = conninfo_to_dict(url)
    except psycopg.ProgrammingError as error:
        sentence = "The URL of the shared ledger is not an address of a PostgreSQL server."
        raise ConfigurationError.stating(sentence, fix="For example: postgresql://robot@server/database") from error
    if parts.get("password") or parts.get("sslpassword"):
        raise ConfigurationError.stating(
            "The URL of the shared ledger contains a password.",
            fix="Remove it from the URL, and put it into ~/.pgpass (mode 0600) or the file that PGPASSFILE names.",
        )


def connect(url: str) -> ServerConnection:
    """Connect to the server at `url`; raises `ConfigurationError` and `ServerUnreachableError`."""
    check_address(url)
    with translated_errors():
        connection = ServerConnection.connect(url, autocommit=True, connect_timeout=CONNECT_TIMEOUT_S)
        try:
            limits = {
                "statement_timeout": STATEMENT_TIMEOUT_S,
                "idle_in_transaction_session_timeout": IDLE_TIMEOUT_S,
            }
            for name, seconds in limits.items():
                connection.execute("SELECT set_config(%s, %s, false)", (name, f"{seconds * 1000:.0f}"))
            connection.execute("SET client_encoding TO 'UTF8'")
        except BaseException:
            connection.close()
            raise
    return connection


@contextmanager
def translated_errors() -> Generator[None]:
    """Raise the errors of a ledger in place of those of psycopg."""
    try:
        yield
    except psycopg.errors.UniqueViolation as error:
        sentence = f"The ledger already contains an episode or a run with this name ({_summary(error)})."
        raise RefusedEntryError.stating(sentence, fix="Use a new episode id or run name.") from error
    except _ACCESS_REFUSED as error:
        raise ServerUnreachableError(_summary(error), access_refused=True) from error
    except (psycopg.OperationalError, psycopg.InterfaceError) as error:
        raise ServerUnreachableError(_summary(error), login_refused=_login_refused(error)) from error
    except psycopg.Error as error:
        if error.sqlstate in _TIMEOUT_STATES:
            raise ServerUnreachableError(_summary(error)) from error
        raise CorruptLedgerError(f"PostgreSQL reports: {_summary(error)}", seq=None, path="(server)") from error


def _login_refused(error: psycopg.Error) -> bool:
    """Whether the server was reached and asked for a password, which is missing or wrong."""
    attempt = error.pgconn
    return attempt is not None and (attempt.needs_password or attempt.used_password)


def _summary(error: Exception) -> str:
    """The first line of the message of `error`."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
