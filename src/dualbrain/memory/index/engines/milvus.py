"""Vectors in Milvus, searched by its index FLAT, which is exact; a server, or Milvus Lite with a file."""

from __future__ import annotations

import math
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.memory.index.engines.engine import RETRY_INTERVAL_S, EngineUnreachableError, Numbers

BATCH = 1000
"""Vectors of one request."""
TIMEOUT_S = 5.0
"""Longest time of one request, with the repetitions of the client [s]."""


class MilvusEngine:
    """See `VectorEngine`; one collection for each dimension of the vectors. Its only writers are the robots."""

    max_count = 16_384

    def __init__(self, address: str, namespace: str, dim: int) -> None:
        """Connect to the server at `address`, or open the file for Milvus Lite, and create the collection."""
        if "://" in address and urlsplit(address).password:
            raise ConfigurationError.stating(
                "The address of Milvus contains a password.", fix="Remove it, and give this machine access without one."
            )
        self._name, self._failed_at = f"{namespace}_{dim}", -math.inf
        with self._translated_errors():
            self._milvus: Any = import_module("pymilvus")
            self._client = self._milvus.MilvusClient(address, timeout=TIMEOUT_S)
            if not self._client.has_collection(self._name, timeout=TIMEOUT_S):
                self._create(dim)
            self._client.load_collection(self._name, timeout=TIMEOUT_S)

    def _create(self, dim: int) -> None:
        kinds = self._milvus.DataType
        schema = self._client.create_schema(auto_id=False)
        schema.add_field("key", kinds.VARCHAR, max_length=48, is_primary=True)
        schema.add_field("seq", kinds.INT64)
        schema.add_field("grp", kinds.INT64)
        schema.add_field("e", kinds.FLOAT_VECTOR, dim=dim)
        index = self._client.prepare_index_params()
        index.add_index(field_name="e", index_type="FLAT", metric_type="IP")
        options = {"consistency_level": "Strong", "timeout": TIMEOUT_S}
        self._client.create_collection(self._name, schema=schema, index_params=index, **options)

    def stored(self) -> tuple[Numbers, Numbers]:
        """See `VectorEngine`."""
        pairs = list[tuple[int, int]]()
        with self._translated_errors():
            fields = ["seq", "grp"]
            pages = self._client.query_iterator(self._name, batch_size=BATCH, output_fields=fields, timeout=TIMEOUT_S)
            while page := pages.next():
                pairs += [(row["seq"], row["grp"]) for row in page]
            pages.close()
        found = np.array(pairs, np.int64).reshape(-1, 2)
        return found[:, 0], found[:, 1]

    def add(self, seqs: Numbers, groups: Numbers, vectors: Float32Array) -> None:
        """See `VectorEngine`."""
        with self._translated_errors():
            for first in range(0, len(seqs), BATCH):
                part = slice(first, first + BATCH)
                rows = zip(seqs[part].tolist(), groups[part].tolist(), vectors[part].tolist(), strict=True)
                entries = [{"key": f"{seq}/{group}", "seq": seq, "grp": group, "e": e} for seq, group, e in rows]
                self._client.upsert(self._name, entries, timeout=TIMEOUT_S)

    def nearest(self, group: int, vector: Float32Array, count: int) -> tuple[Numbers, Float32Array]:
        """See `VectorEngine`."""
        with self._translated_errors():
            found = self._client.search(
                self._name,
                [vector.tolist()],
                limit=min(count, self.max_count),
                filter=f"grp == {group}",
                search_params={"metric_type": "IP"},
                output_fields=["seq"],
                timeout=TIMEOUT_S,
            )[0]
        best = {int(hit["entity"]["seq"]): float(hit["distance"]) for hit in found}  # Lite may return a row twice
        return np.array(list(best), np.int64), np.array(list(best.values()), np.float32)

    def close(self) -> None:
        """See `VectorEngine`."""
        with suppress(Exception):  # a client that does not end cleanly must not keep the ledger open
            self._client.close()

    @contextmanager
    def _translated_errors(self) -> Generator[None]:
        """Raise `EngineUnreachableError` for every error of Milvus, whose client has no common class of errors.

        After an error, no other request is tried for `RETRY_INTERVAL_S`.
        """
        if time.monotonic() < self._failed_at + RETRY_INTERVAL_S:
            raise EngineUnreachableError("Milvus: it did not answer before")
        try:
            yield
        except (DualbrainError, ModuleNotFoundError):
            raise
        except Exception as error:
            self._failed_at = time.monotonic()
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise EngineUnreachableError(f"Milvus: {reason}") from error
