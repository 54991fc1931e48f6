"""Vectors in PostgreSQL with the extension pgvector, searched by a sequential scan, which is exact.

The storage of the column is PLAIN: with the default, a vector of 2 kB is stored out of line, and a search takes several
times as long.
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
from dualbrain.memory.index.engines.engine import EngineUnreachableError, Numbers
from dualbrain.memory.ledger.postgres.connection import ServerConnection, connect
from dualbrain.memory.ledger.store import ServerUnreachableError

TABLE = "vector_index"
RETRY_INTERVAL_S = 10.0
BATCH = 500
"""Vectors of one statement."""


class PgvectorEngine:
    """See `VectorEngine`; a table in the schema of the ledger."""

    max_count = 2**31 - 1

    def __init__(self, url: str, namespace: str, dim: int) -> None:
        """Connect, and create the table unless it exists."""
        self._url, self._dim = url, dim
        self._table = sql.Identifier(namespace, TABLE)
        self._open: ServerConnection | None = None
        self._failed_at = -math.inf
        with _translated_errors():
            if not self._has_table(namespace):
                self._create_table(namespace)

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
        return self._open

    def _has_table(self, namespace: str) -> bool:
        query = "SELECT 1 FROM information_schema.tables WHERE table_schema = %s AND table_name = %s"
        return self._connection.execute(query, (namespace, TABLE)).fetchone() is not None

    def _create_table(self, namespace: str) -> None:
        try:
            with self._connection.transaction():
                for text in (
                    "CREATE EXTENSION IF NOT EXISTS vector",
                    "CREATE SCHEMA IF NOT EXISTS {schema}",
                    "CREATE TABLE {table} (seq bigint, grp bigint, e vector({dim}) NOT NULL, PRIMARY KEY (seq, grp))",
                    "ALTER TABLE {table} ALTER COLUMN e SET STORAGE PLAIN",
                    "CREATE INDEX ON {table} (grp)",
                ):
                    statement = sql.SQL(text).format(
                        schema=sql.Identifier(namespace), table=self._table, dim=sql.Literal(self._dim)
                    )
                    self._connection.execute(statement)
        except (psycopg.errors.FeatureNotSupported, psycopg.errors.InsufficientPrivilege) as error:
            raise ConfigurationError.stating(
                f"The table of the index cannot be created: {str(error).splitlines()[0]}.",
                fix="Install pgvector on the server, and open the ledger once as the owner of its tables.",
            ) from error

    def stored(self) -> tuple[Numbers, Numbers]:
        """See `VectorEngine`."""
        with _translated_errors():
            found = self._connection.execute(sql.SQL("SELECT seq, grp FROM {}").format(self._table)).fetchall()
        pairs = np.array(found, np.int64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def add(self, seqs: Numbers, groups: Numbers, vectors: Float32Array) -> None:
        """See `VectorEngine`."""
        insert = sql.SQL("INSERT INTO {} VALUES (%s, %s, %s::vector) ON CONFLICT DO NOTHING").format(self._table)
        with _translated_errors():
            for first in range(0, len(seqs), BATCH):
                part = slice(first, first + BATCH)
                rows = zip(seqs[part].tolist(), groups[part].tolist(), map(_encode, vectors[part]), strict=True)
                with self._connection.transaction(), self._connection.cursor() as cursor:
                    cursor.executemany(insert, list(rows))

    def nearest(self, group: int, vector: Float32Array, count: int) -> tuple[Numbers, Float32Array]:
        """See `VectorEngine`."""
        query = sql.SQL(
            "SELECT seq, -(e <#> %s::vector) AS p FROM {} WHERE grp = %s ORDER BY e <#> %s::vector LIMIT %s"
        )
        text = _encode(vector)
        with _translated_errors():
            found = self._connection.execute(query.format(self._table), (text, group, text, count)).fetchall()
        return np.array([row[0] for row in found], np.int64), np.array([row[1] for row in found], np.float32)

    def close(self) -> None:
        """See `VectorEngine`."""
        if self._open is not None:
            self._open.close()


def _encode(vector: Float32Array) -> str:
    """The text form of a vector, from which the same float32 numbers are read."""
    return msgspec.json.encode(vector.tolist()).decode()


@contextmanager
def _translated_errors() -> Generator[None]:
    """Raise `EngineUnreachableError` for a server that does not answer or refuses."""
    try:
        yield
    except (psycopg.Error, ServerUnreachableError) as error:
        raise EngineUnreachableError(f"pgvector: {str(error).splitlines()[0]}") from error
