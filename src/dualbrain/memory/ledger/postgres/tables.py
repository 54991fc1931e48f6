"""The tables of a ledger in PostgreSQL: one schema with events, vectors, and triggers that protect the events.

Run, subject and payload are bytes, so that every text is stored exactly with every encoding of the database. The table
of vectors is not called `vector`, because pgvector has a type of this name.
"""

from __future__ import annotations

import hashlib
from typing import Any

import psycopg
from psycopg import sql

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.hash_chain import GENESIS
from dualbrain.memory.ledger.sqlite.tables import SCHEMA_VERSION

TRIGGERS = ("event_follows_chain", "event_is_never_changed", "event_is_never_emptied")
INDICES = ("event_kind", "event_subject", "event_time", "one_episode", "one_start")
_STATEMENTS = (
    "CREATE SCHEMA IF NOT EXISTS {schema}",
    "CREATE TABLE {schema}.meta (key text PRIMARY KEY, value text NOT NULL)",
    "INSERT INTO {schema}.meta VALUES ('schema_version', {version})",
    "CREATE TABLE {schema}.event (seq bigint PRIMARY KEY, kind text NOT NULL, run bytea NOT NULL, "
    "subject bytea NOT NULL, time double precision NOT NULL, payload bytea NOT NULL, previous text NOT NULL, "
    "hash text NOT NULL)",
    "CREATE INDEX event_kind ON {schema}.event (kind, run)",
    "CREATE INDEX event_subject ON {schema}.event (subject, kind)",
    "CREATE INDEX event_time ON {schema}.event (time)",
    "CREATE UNIQUE INDEX one_episode ON {schema}.event (subject) WHERE kind = 'episode'",
    "CREATE UNIQUE INDEX one_start ON {schema}.event (run) WHERE kind = 'run_started'",
    "CREATE TABLE {schema}.embedding (seq bigint PRIMARY KEY REFERENCES {schema}.event (seq), version text NOT NULL, "
    "data bytea NOT NULL, mask integer NOT NULL)",
    "CREATE FUNCTION {schema}.refuse_change() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
    "RAISE EXCEPTION 'the ledger is append-only' USING ERRCODE = 'restrict_violation'; END $$",
    "CREATE FUNCTION {schema}.check_link() RETURNS trigger LANGUAGE plpgsql AS $$ DECLARE head record; BEGIN "
    "SELECT seq, hash INTO head FROM {schema}.event ORDER BY seq DESC LIMIT 1; "
    "IF NEW.seq <> coalesce(head.seq, 0) + 1 OR NEW.previous <> coalesce(head.hash, {genesis}) THEN "
    "RAISE EXCEPTION 'event % does not follow the newest event', NEW.seq USING ERRCODE = 'restrict_violation'; "
    "END IF; RETURN NEW; END $$",
    "CREATE TRIGGER event_is_never_changed BEFORE UPDATE OR DELETE ON {schema}.event "
    "FOR EACH ROW EXECUTE FUNCTION {schema}.refuse_change()",
    "CREATE TRIGGER event_is_never_emptied BEFORE TRUNCATE ON {schema}.event EXECUTE FUNCTION {schema}.refuse_change()",
    "CREATE TRIGGER event_follows_chain BEFORE INSERT ON {schema}.event "
    "FOR EACH ROW EXECUTE FUNCTION {schema}.check_link()",
)
Connection = psycopg.Connection[tuple[Any, ...]]


def create_tables(connection: Connection, namespace: str) -> None:
    """Create the tables of a ledger in the schema `namespace`, in one transaction; existing ones are left as they are.

    Raises the errors of psycopg.
    """
    names = {
        "schema": sql.Identifier(namespace),
        "version": sql.Literal(str(SCHEMA_VERSION)),
        "genesis": sql.Literal(GENESIS),
    }
    with connection.transaction():
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (lock_key(namespace),))
        if _has_tables(connection, namespace):
            return
        for statement in _STATEMENTS:
            connection.execute(sql.SQL(statement).format(**names))


def check_tables(connection: Connection, namespace: str) -> tuple[str, ...]:
    """The declared triggers and indices that are missing or disabled in the schema `namespace`.

    Raises `ConfigurationError` if there are no tables of this version, and the errors of psycopg.
    """
    if not _has_tables(connection, namespace):
        raise ConfigurationError.stating(
            f"The database has no memory ledger in the schema {namespace!r}.",
            fix="Create its tables with `dualbrain memory connect URL FILE --create`.",
        )
    query = sql.SQL("SELECT value FROM {}.meta WHERE key = 'schema_version'").format(sql.Identifier(namespace))
    row = connection.execute(query).fetchone()
    if row is None or row[0] != str(SCHEMA_VERSION):
        raise ConfigurationError(
            "ledger schema_version",
            got=row[0] if row else "none",
            allowed=str(SCHEMA_VERSION),
            fix="Update dualbrain on every robot of this ledger.",
        )
    indices = connection.execute("SELECT indexname FROM pg_indexes WHERE schemaname = %s", (namespace,))
    triggers = list_triggers(connection, namespace)
    found = {str(name) for (name,) in indices}
    missing_triggers = [f"trigger {name!r}" for name in TRIGGERS if name not in triggers]
    return tuple([f"index {name!r}" for name in INDICES if name not in found] + missing_triggers)


def list_triggers(connection: Connection, namespace: str) -> frozenset[str]:
    """Names of the enabled triggers of the tables in the schema `namespace`."""
    rows = connection.execute(
        "SELECT t.tgname FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid JOIN pg_namespace n "
        "ON n.oid = c.relnamespace WHERE n.nspname = %s AND NOT t.tgisinternal AND t.tgenabled <> 'D'",
        (namespace,),
    )
    return frozenset(str(name) for (name,) in rows)


def lock_key(namespace: str) -> int:
    """Key of the advisory lock that a writer of the ledger in `namespace` holds."""
    digest = hashlib.sha256(b"dualbrain ledger " + namespace.encode()).digest()
    return int.from_bytes(digest[:8], "little", signed=True)


def _has_tables(connection: Connection, namespace: str) -> bool:
    query = (
        "SELECT 1 FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace WHERE n.nspname = %s AND relname = %s"
    )
    return connection.execute(query, (namespace, "meta")).fetchone() is not None
