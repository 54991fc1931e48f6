"""Speed of the memory: search, update and start, and the search of vector databases.

    python -m benchmarks.memory.speed [--sizes 10000 100000] [--start 100000] [--peers] [--json]

The search returns the exact top 10 of R, with filters, over random vectors of dimension 512. It alternates in one
process with one single-threaded matrix-vector product with the same matrix; times are processor times, which other
load does not lengthen. An update is compared with one synchronized write. `--peers` runs Milvus Lite, LanceDB and
pgvector in a separate environment (`vector_databases/requirements.txt`), each compared with the same product in its
process, by wall time, because their work is partly in other processes. All times are medians.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.joint_embedding import JointEmbedding
from dualbrain.memory.index.filters import Columns, Filter
from dualbrain.memory.index.index import to_stored_vector
from dualbrain.memory.ledger.ledger import Ledger, PendingEvent
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.hebbian_update import BANDWIDTH
from dualbrain.memory.retrieval.search import FlatIndex, Query, contract_weights
from dualbrain.memory.state.episode_record import episode_payload
from dualbrain.memory.state.provenance import Provenance
from dualbrain.memory.state.state import MemoryState
from experiments.memory.synthetic_episodes import (
    CONFIG,
    REGISTRY,
    REST_POSTURE,
    ROBOT,
    START_TIME,
    grasp_contract,
    synthetic_episode,
)

DIM, TOP, LAMBDA = 512, 10, 0.8
HERE = Path(__file__).resolve().parent
PEER_PYTHON = HERE.parents[1] / "build" / "memory_peers" / "venv" / "bin" / "python"
SEARCH_FILTER = Filter(robot=ROBOT, registry=REGISTRY, guidance="follow", skills=("grasp",), after=START_TIME)
WEIGHT_FILTER, MEMORIES_PER_CONTRACT = Filter(robot=ROBOT, registry=REGISTRY), 5
"""Filter of the memories whose weights count for a contract, and number of memories per contract."""


def main() -> int:
    options = parse()
    report: dict[str, Any] = {"machine": f"{platform.machine()}, {os.cpu_count()} cores", "load": os.getloadavg()[0]}
    report["search"] = [measure_search(n, options.rounds) for n in options.sizes]
    report["update"] = measure_update(options.rounds)
    if options.start:
        report["start"] = measure_start(options.start)
    if options.peers:
        report["peers"] = run_peers()
    print(json.dumps(report, indent=None if options.json else 1))
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="*", default=[10_000, 100_000], help="numbers of memories to search")
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--start", type=int, default=0, help="also measure the start with this number of episodes")
    parser.add_argument(
        "--peers", action="store_true", help="also measure Milvus Lite, LanceDB and pgvector with 1e5 memories"
    )
    parser.add_argument("--json", action="store_true", help="print one line")
    return parser.parse_args()


def measure_search(n: int, rounds: int) -> dict[str, float]:
    """Return median processor times of search and product over `rounds` alternating calls [ms], and their ratio."""
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((n, DIM), dtype=np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    index, columns = FlatIndex(DIM), Columns()
    index.load(rows, rng.random(n), np.ones(n, np.uint8))
    for row in range(n):
        columns.add(_memory_state(row, "succeeded" if row % 10 else "failed"))
    queries = rows[rng.integers(0, n, rounds)] + 0.05 * rng.standard_normal((rounds, DIM), dtype=np.float32)
    searches, products = list[float](), list[float]()
    for query in queries:
        products.append(_elapsed_ms(lambda query=query: rows @ query, time.thread_time))
        searches.append(_elapsed_ms(lambda query=query: _top(index, columns, query), time.thread_time))
    n_warm_up = len(searches) // 5
    a, b = statistics.median(searches[n_warm_up:]), statistics.median(products[n_warm_up:])
    return {"rows": n, "search_ms": a, "product_ms": b, "ratio": a / b}


def _top(index: FlatIndex, columns: Columns, query: np.ndarray) -> object:
    compared = index.compare(Query.single_block(query))
    weights = contract_weights(compared, index.weights, columns.contract_codes, columns.mask(WEIGHT_FILTER), BANDWIDTH)
    return index.top_k(compared, columns.mask(SEARCH_FILTER), TOP, LAMBDA, weights)


def _memory_state(row: int, kind: Any) -> MemoryState:
    skills = ("grasp", "place") if row % 2 else ("grasp",)
    origin = Provenance(source="planner", contract=str(row // MEMORIES_PER_CONTRACT), skills=skills)
    return MemoryState(
        id=str(row),
        seq=row,
        time=START_TIME + row,
        run="",
        robot=ROBOT,
        registry=REGISTRY,
        kind=kind,
        Delta=0.001,
        provenance=origin,
        status="active",
        w0=0.5,
        weight=0.5,
    )


def measure_update(rounds: int) -> dict[str, float]:
    """Return the time to store an episode that updates 100 neighbours, and to synchronize one small event [ms]."""
    with tempfile.TemporaryDirectory(prefix="dualbrain-speed-") as folder:
        with Ledger(Path(folder) / "a.db", holder="benchmark", now=START_TIME) as ledger:
            memory = Memory(ledger, HashingEncoder(64), CONFIG)
            for number in range(150):
                memory.store(synthetic_episode(f"seed-{number}", kind="declined"), REST_POSTURE, now=START_TIME)
            stores, syncs, n_updated = list[float](), list[float](), 0
            for number in range(rounds):
                syncs.append(
                    _elapsed_ms(
                        lambda: ledger.append([PendingEvent(kind="note", subject="", payload=1)], now=START_TIME)
                    )
                )
                kind = "succeeded" if number % 2 else "failed"
                one = synthetic_episode(f"e-{number}", kind=kind)
                start = time.perf_counter()
                n_updated = max(
                    n_updated, memory.store(one, REST_POSTURE, now=START_TIME + 86400.0 * number).n_neighbours
                )
                stores.append((time.perf_counter() - start) * 1e3)
        a, b = statistics.median(stores), statistics.median(syncs)
        return {"neighbours": n_updated, "store_ms": a, "synced_event_ms": b, "ratio": a / b}


def measure_start(n: int) -> dict[str, float]:
    """Return the times to open a memory of `n` episodes in new processes, from all events and from the snapshot [s]."""
    with tempfile.TemporaryDirectory(prefix="dualbrain-speed-") as folder:
        path = Path(folder) / "a.db"
        _fill_ledger(path, n)
        first, *again = (_time_open(path) for _ in range(4))
        size = sum(file.stat().st_size for file in Path(folder).iterdir()) / 1e6
    (wall, processor), best = first, min(again)
    return {
        "episodes": n,
        "from_events_s": wall,
        "from_events_processor_s": processor,
        "from_snapshot_s": best[0],
        "from_snapshot_processor_s": min(one[1] for one in again),
        "files_MB": size,
    }


def _time_open(path: Path) -> tuple[float, float]:
    """Return wall and processor time to open the memory in a new process, without the imports [s]."""
    program = (
        "import time, sys, pathlib; from dualbrain.memory.embedding.hashing_encoder import HashingEncoder; "
        "from dualbrain.memory.memory import Memory; from dualbrain.memory.ledger.ledger import Ledger; "
        "from experiments.memory.synthetic_episodes import CONFIG, START_TIME; "
        "start = time.perf_counter(), time.process_time(); "
        "ledger = Ledger(pathlib.Path(sys.argv[1]), holder='benchmark', now=START_TIME); "
        "memory = Memory(ledger, HashingEncoder(384), CONFIG); "
        "elapsed = time.perf_counter() - start[0], time.process_time() - start[1]; "
        "assert len(memory); ledger.close(); print(*elapsed)"
    )
    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), "-c", program, str(path)]
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environ)
    wall, processor = map(float, done.stdout.split())
    return wall, processor


def _fill_ledger(path: Path, n: int) -> None:
    """Write a ledger of `n` episodes with one weight event each, in large transactions."""
    embedding = JointEmbedding(HashingEncoder(384), CONFIG.limits, CONFIG.embedding)
    version, rng = embedding.version(ROBOT), np.random.default_rng(1)
    base = embedding.embed("grasp the cube", "cube: object, neighbour_across low", REST_POSTURE, ROBOT)
    with Ledger(path, holder="benchmark", now=START_TIME) as ledger:
        for first in range(0, n, 1000):
            entries = list[PendingEvent]()
            for number in range(first, min(first + 1000, n)):
                one = synthetic_episode(f"e-{number}", plan=grasp_contract(object="cube", speed=0.1 + number * 1e-6))
                body = episode_payload(one, REST_POSTURE, None, version, CONFIG.plasticity, "active")
                noisy = base.vector + 0.02 * rng.standard_normal(embedding.dim, dtype=np.float32)
                entries.append(
                    PendingEvent(
                        kind="episode",
                        subject=one.id,
                        payload=body,
                        vector=to_stored_vector(type(base)(noisy, base.mask), version),
                    )
                )
                update = {"cause": one.id, "memory": one.id, "rule": "reinforce", "rank": 0, "gain": 0.95}
                entries.append(
                    PendingEvent(
                        kind="weight", subject=one.id, payload={**update, "offset": 0.1, "before": 0.5, "after": 0.575}
                    )
                )
            ledger.append(entries, now=START_TIME + first)


def run_peers() -> object:
    """Return the result of the vector databases, or the reason why they did not run."""
    if not PEER_PYTHON.exists():
        return "Not installed; benchmarks/memory/vector_databases/requirements.txt describes the installation."
    done = subprocess.run(
        [str(PEER_PYTHON), str(HERE / "vector_databases" / "search.py")], capture_output=True, text=True, check=False
    )
    return json.loads(done.stdout) if done.returncode == 0 else done.stderr[-800:]


def _elapsed_ms(function: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    start = clock()
    function()
    return (clock() - start) * 1e3


if __name__ == "__main__":
    sys.exit(main())
