"""Vectors in PostgreSQL with the extension pgvector, searched by a sequential scan, which is exact.

The storage of the column is PLAIN: with the default, a vector of 2 kB is stored out of line, and a search takes several
times as long. Ordered index scans are off, so that an approximate index on the table changes no result.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator
from contextlib import contextmanager

import msgspec
import numpy as np
import psycopg
from psycopg import sql

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import ConfigurationError
from dualbrain.memory.index.engines.engine import (
    RETRY_INTERVAL_S,
    EngineRefusalError,
    EngineUnreachableError,
    Numbers,
)
from dualbrain.memory.ledger.postgres.connection import ServerConnection, connect
from dualbrain.memory.ledger.store import ServerUnreachableError

BATCH = 500
"""Vectors of one statement."""
_STATEMENTS = (
    "SELECT pg_advisory_xact_lock(hashtext({name}))",
    "CREATE EXTENSION IF NOT EXISTS vector",
    "CREATE SCHEMA IF NOT EXISTS {schema}",
    "CREATE TABLE IF NOT EXISTS {table} (seq bigint, grp bigint, e vector({dim}) NOT NULL, PRIMARY KEY (seq, grp))",
    "ALTER TABLE {table} ALTER COLUMN e SET STORAGE PLAIN",
    "CREATE INDEX IF NOT EXISTS {index} ON {table} (grp)",
)


class PgvectorEngine:
    """See `VectorEngine`; a table in the schema of the ledger, one for each dimension of the vectors."""

    max_count = 2**31 - 1

    def __init__(self, url: str, namespace: str, dim: int) -> None:
        """Connect, and create the table unless it exists; raises `ConfigurationError` if that is not possible."""
        self._url, self._dim = url, dim
        self._namespace, self._name = namespace, f"vector_index_{dim}"
        self._table = sql.Identifier(namespace, self._name)
        self._open: ServerConnection | None = None
        self._failed_at = -math.inf
        try:
            with self._translated_errors():
                if not self._has_table():
                    self._create_table()
        except BaseException:
            self.close()
            raise

    @property
    def _connection(self) -> ServerConnection:
        """The connection; after a failure, a new one is tried once in `RETRY_INTERVAL_S`."""
        if self._open is None or self._open.closed:
            if time.monotonic() < self._failed_at + RETRY_INTERVAL_S:
                raise EngineUnreachableError("pgvector: the server did not answer before")
            try:
                self._open = connect(self._url)
            except ServerUnreachableError:
                self._failed_at = time.monotonic()
                raise
            self._open.execute("SET enable_indexscan TO off")
        return self._open

    def _has_table(self) -> bool:
        found = self._connection.execute("SELECT to_regclass(%s)", (f'"{self._namespace}".{self._name}',)).fetchone()
        return found is not None and found[0] is not None

    def _create_table(self) -> None:
        names = {
            "name": sql.Literal(f"{self._namespace}.{self._name}"),
            "schema": sql.Identifier(self._namespace),
            "table": self._table,
            "index": sql.Identifier(f"{self._name}_grp"),
            "dim": sql.Literal(self._dim),
        }
        try:
            with self._connection.transaction():
                for text in _STATEMENTS:
                    self._connection.execute(sql.SQL(text).format(**names))
        except (psycopg.errors.FeatureNotSupported, psycopg.errors.UndefinedFile) as error:
            problem = f"The server has no pgvector: {_summary(error)}."
            raise ConfigurationError.stating(problem, fix="Install the extension on the server.") from error
        except (psycopg.errors.InsufficientPrivilege, psycopg.errors.InvalidSchemaName) as error:
            problem = f"The table {self._name} of the index does not exist, and cannot be created: {_summary(error)}."
            fix = "Create it as the owner of the ledger: `dualbrain memory connect … --create --index pgvector`."
            raise ConfigurationError.stating(problem, fix=fix) from error

    @property
    def grant(self) -> str:
        """The statement that lets a role use the table."""
        return f"GRANT SELECT, INSERT ON {self._namespace}.{self._name} TO …"

    def stored(self) -> tuple[Numbers, Numbers]:
        """See `VectorEngine`."""
        with self._translated_errors():
            found = self._connection.execute(sql.SQL("SELECT seq, grp FROM {}").format(self._table)).fetchall()
        pairs = np.array(found, np.int64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def add(self, seqs: Numbers, groups: Numbers, vectors: Float32Array) -> None:
        """See `VectorEngine`."""
        text = (
            "INSERT INTO {} SELECT seq, grp, e::vector FROM unnest(%s::bigint[], %s::bigint[], %s::text[]) "
            "AS fresh (seq, grp, e) ON CONFLICT DO NOTHING"
        )
        insert = sql.SQL(text).format(self._table)
        with self._translated_errors():
            for first in range(0, len(seqs), BATCH):
                part = slice(first, first + BATCH)
                values = (seqs[part].tolist(), groups[part].tolist(), [_encode(vector) for vector in vectors[part]])
                self._connection.execute(insert, values)

    def nearest(self, group: int, vector: Float32Array, count: int) -> tuple[Numbers, Float32Array]:
        """See `VectorEngine`."""
        select = "SELECT seq, -(e <#> %s::vector) FROM {} WHERE grp = %s ORDER BY e <#> %s::vector LIMIT %s"
        query, text = sql.SQL(select), _encode(vector)
        with self._translated_errors():
            found = self._connection.execute(query.format(self._table), (text, group, text, count)).fetchall()
        return np.array([row[0] for row in found], np.int64), np.array([row[1] for row in found], np.float32)

    def close(self) -> None:
        """See `VectorEngine`."""
        if self._open is not None:
            self._open.close()

    @contextmanager
    def _translated_errors(self) -> Generator[None]:
        """Raise the errors of an engine in place of those of psycopg."""
        try:
            yield
        except psycopg.errors.InsufficientPrivilege as error:
            raise EngineRefusalError(f"pgvector: {_summary(error)}. As the owner: {self.grant}") from error
        except (psycopg.errors.ReadOnlySqlTransaction, psycopg.DataError, psycopg.ProgrammingError) as error:
            raise EngineRefusalError(f"pgvector: {_summary(error)}") from error
        except (psycopg.Error, ServerUnreachableError) as error:
            raise EngineUnreachableError(f"pgvector: {_summary(error)}") from error


def _encode(vector: Float32Array) -> str:
    """The text form of a vector, from which the same float32 numbers are read."""
    return msgspec.json.encode(vector.tolist()).decode()


def _summary(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
