"""Crash recovery: four clients share a ledger and are killed at random times; acknowledged episodes must survive."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.memory import memory as memory_module
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.joint_embedding import JointEmbedding
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.maintenance.verification import verify
from dualbrain.memory.memory import Memory
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.memory.synthetic_episodes import (
    CONFIG,
    LIMITS,
    REGISTRY,
    REST_POSTURE,
    ROBOT,
    START_TIME,
    synthetic_episode,
)

N_CLIENTS, ROUNDS_PER_LEDGER, N_LEDGERS = 4, 10, 20
MAX_ROUND_S = 0.6
"""Time of a round after which all clients have been killed [s]."""
OUTCOMES = ("succeeded", "failed", "rejected")


class CrashRecovery:
    """Crash safety of the ledger."""

    name = "crash_recovery"
    claim = (
        "With kill -9 at random times, in 200 rounds of four concurrent clients, no acknowledged event is lost, the "
        "hash chain stays valid, and vectors and weights are rebuilt equal."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Twenty ledgers of ten rounds each."""
        del options
        return [WorkUnit(f"ledger {seed}", {"seed": seed, "rounds": ROUNDS_PER_LEDGER}) for seed in range(N_LEDGERS)]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Ten rounds on one growing ledger."""
        rng = np.random.default_rng(parameters["seed"])
        acknowledged, faults, lost = set[str](), list[str](), 0
        with tempfile.TemporaryDirectory(prefix="dualbrain-crash-") as folder:
            path = Path(folder) / "ledger.sqlite"
            for number in range(parameters["rounds"]):
                acknowledged |= run_round(path, number, rng)
                fault, missing = check_ledger(path, acknowledged)
                faults += [f"round {number}: {fault}"] if fault else []
                lost = missing
        return {"rounds": parameters["rounds"], "acknowledged": len(acknowledged), "lost": lost, "faults": faults}

    def summarize_row(self, row: Row) -> str:
        """The counts."""
        return f"{row['acknowledged']} acknowledged, {row['lost']} lost, {len(row['faults'])} faults"

    def report(self, rows: list[Row]) -> list[str]:
        """Totals and every fault."""
        rounds, acknowledged = (sum(row[name] for row in rows) for name in ("rounds", "acknowledged"))
        lost, faults = sum(row["lost"] for row in rows), [fault for row in rows for fault in row["faults"]]
        head = ("rounds", "episodes acknowledged", "lost", "rounds with a fault")
        return markdown_table(head, [(rounds, acknowledged, lost, format_proportion(len(faults), rounds))]) + faults


def run_round(path: Path, number: int, rng: np.random.Generator) -> set[str]:
    """Start the clients and kill each at a random time; returns the acknowledged episodes."""
    children = {
        _fork_client(path, f"{number}-{client}", int(rng.integers(2**31))): client for client in range(N_CLIENTS)
    }
    pipes = [pipe for _, pipe in children]
    times = sorted(zip(rng.uniform(0.05, MAX_ROUND_S, N_CLIENTS).tolist(), [pid for pid, _ in children], strict=True))
    start = time.monotonic()
    for delay, pid in times:
        time.sleep(max(0.0, start + delay - time.monotonic()))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    acknowledged = set[str]()
    for pipe in pipes:
        with os.fdopen(pipe) as lines:
            acknowledged |= {line.strip() for line in lines if line.endswith("\n")}
    return acknowledged


def _fork_client(path: Path, name: str, seed: int) -> tuple[int, int]:
    reading, writing = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writing)
        return pid, reading
    try:
        run_client(path, name, np.random.default_rng(seed), writing)
    finally:
        os._exit(1)


def run_client(path: Path, name: str, rng: np.random.Generator, acknowledgements: int) -> None:
    """Open the ledger, store a few episodes with retrieved memories, close it, in a loop.

    Each acknowledged episode is written to the file descriptor `acknowledgements`.
    """
    memory_module.SNAPSHOT_MIN_EVENTS = 40
    count = 0
    while True:
        with Ledger(path, holder=name, now=START_TIME, timeout_s=60.0) as ledger:
            memory = Memory(ledger, HashingEncoder(32), CONFIG)
            for _ in range(int(rng.integers(1, 4))):
                recall = memory.retrieve("grasp the cube", "cube: object", REST_POSTURE, ROBOT, REGISTRY, k=3)
                one = f"{name}-{count}"
                kind = OUTCOMES[int(rng.integers(len(OUTCOMES)))]
                memory.store(synthetic_episode(one, kind=kind, recall=recall), REST_POSTURE, now=START_TIME)
                os.write(acknowledgements, f"{one}\n".encode())
                count += 1


def check_ledger(path: Path, acknowledged: set[str]) -> tuple[str, int]:
    """The fault of the ledger ("" if it has none), and the number of acknowledged episodes that it lacks."""
    if not path.exists():
        return "", len(acknowledged)
    embedding = JointEmbedding(HashingEncoder(32), (LIMITS,), CONFIG.embedding)
    with Ledger(path, holder="crash_recovery", now=START_TIME) as ledger:
        found = verify(ledger, embedding=embedding)
        kept = {event.subject for event in ledger.events("episode")}
        memory = Memory(ledger, HashingEncoder(32), CONFIG)
        loaded = {one.id: one.weight for one in memory.state.memories}
        replayed = memory_module.derive_state(ledger).weights()
    fault = "" if found.is_intact else f"{found.chain.fault or found.snapshot}, {found.vectors_wrong} vectors differ"
    return fault or ("" if loaded == replayed else "weights differ after a rebuild"), len(acknowledged - kept)
