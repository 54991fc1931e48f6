"""The vector engine that the file of a shared ledger names."""

from __future__ import annotations

from dualbrain.errors import ConfigurationError
from dualbrain.memory.index.engines.engine import VectorEngine

PGVECTOR = "pgvector"
"""The name of the engine on the PostgreSQL server of a shared ledger."""
MILVUS_PREFIX = "milvus:"
"""Precedes the address of a Milvus server, or the path of a file for Milvus Lite."""


def open_engine(name: str, *, url: str, namespace: str, dim: int) -> VectorEngine:
    """The engine called `name`: `pgvector` on the server at `url`, or `milvus:ADDRESS`.

    Tables and collections are created in `namespace` if they do not exist.

    Raises:
        ConfigurationError: The name is unknown, or the server has no pgvector.
        EngineUnreachableError: The engine does not answer.
    """
    if name == PGVECTOR:
        from dualbrain.memory.index.engines.pgvector import PgvectorEngine  # noqa: PLC0415 - needs psycopg

        return PgvectorEngine(url, namespace, dim)
    if name.startswith(MILVUS_PREFIX):
        from dualbrain.memory.index.engines.milvus import MilvusEngine  # noqa: PLC0415 - needs pymilvus

        return MilvusEngine(name.removeprefix(MILVUS_PREFIX), namespace, dim)
    raise ConfigurationError("index of the shared ledger", got=name, allowed="scan, pgvector or milvus:ADDRESS")
