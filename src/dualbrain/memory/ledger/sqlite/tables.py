"""The tables of a ledger file, their schema version, and the migrations from older versions."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from functools import cache

from dualbrain.core.storage.sqlite import split_statements, transaction
from dualbrain.errors import ConfigurationError

SCHEMA_VERSION = 2
MIGRATED = "migrated"
"""Kind of the event that records a migration, with the schema versions before and after."""

_SCHEMA_V1 = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
INSERT INTO meta VALUES ('schema_version', '1');
CREATE TABLE event (
    seq INTEGER PRIMARY KEY, kind TEXT NOT NULL, run TEXT NOT NULL, subject TEXT NOT NULL, time REAL NOT NULL,
    payload BLOB NOT NULL, previous TEXT NOT NULL, hash TEXT NOT NULL);
CREATE INDEX event_kind ON event (kind, run);
CREATE UNIQUE INDEX one_episode ON event (subject) WHERE kind = 'episode';
CREATE UNIQUE INDEX one_start ON event (run) WHERE kind = 'run_started';
CREATE TRIGGER event_is_never_changed BEFORE UPDATE ON event BEGIN SELECT raise(ABORT, 'append-only'); END;
CREATE TRIGGER event_is_never_removed BEFORE DELETE ON event BEGIN SELECT raise(ABORT, 'append-only'); END;
CREATE TABLE vector (seq INTEGER PRIMARY KEY REFERENCES event (seq), version TEXT NOT NULL, data BLOB NOT NULL);
"""
_MIGRATIONS: Mapping[int, str] = {
    1: """
ALTER TABLE vector ADD COLUMN mask INTEGER NOT NULL DEFAULT 0;
CREATE INDEX event_subject ON event (subject, kind);
CREATE INDEX event_time ON event (time);
""",
}
"""Migration from each version to the next. It may add columns and indices but never changes an event, so that the chain
stays valid."""


@cache
def declared_objects(version: int) -> Mapping[tuple[str, str], str]:
    """The SQL text of every table, index and trigger of schema `version`, by type and name (see `stored_objects`)."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        for script in (_SCHEMA_V1, *(_MIGRATIONS[before] for before in range(1, version))):
            for statement in split_statements(script):
                database.execute(statement)
        return stored_objects(database)


def stored_objects(database: sqlite3.Connection) -> Mapping[tuple[str, str], str]:
    """The SQL text of every object in the file of `database` by type and name, with single spaces.

    It is "" for automatic indices.
    """
    rows = database.execute("SELECT type, name, sql FROM sqlite_master")
    return {(str(kind), str(name)): " ".join(str(sql or "").split()) for kind, name, sql in rows}


def create_missing_guards(database: sqlite3.Connection) -> None:
    """Create the declared indices and triggers that the file of `database` lacks."""
    stored, declared = stored_objects(database), declared_objects(read_schema_version(database))
    with transaction(database):
        for key, sql in declared.items():
            if key not in stored and key[0] in ("index", "trigger"):
                database.execute(sql)


def create_or_migrate(database: sqlite3.Connection) -> int:
    """Create the tables or migrate them to `SCHEMA_VERSION`, in one transaction; returns the version found (0: none).

    Raises `ConfigurationError` for an unknown version. A process killed during the migration leaves the old version
    intact.
    """
    found = read_schema_version(database)
    if found == SCHEMA_VERSION:
        return found
    steps = [_MIGRATIONS[version] for version in range(max(found, 1), SCHEMA_VERSION)]
    set_version = f"UPDATE meta SET value = '{SCHEMA_VERSION}' WHERE key = 'schema_version';"
    with transaction(database):
        for statement in split_statements("".join(("" if found else _SCHEMA_V1, *steps, set_version))):
            database.execute(statement)
    return found


def read_schema_version(database: sqlite3.Connection) -> int:
    """The version of the tables, 0 if there are none; raises `ConfigurationError` for an unknown version."""
    if not database.execute("SELECT 1 FROM sqlite_master").fetchone():
        return 0
    rows = database.execute("SELECT value FROM meta WHERE key = 'schema_version'").fetchall()
    found = rows[0][0] if rows else "none"
    known = [str(version) for version in range(1, SCHEMA_VERSION + 1)]
    if found not in known:
        raise ConfigurationError(
            "ledger schema_version", got=found, allowed=" or ".join(known), fix="Update dualbrain."
        )
    return int(found)
