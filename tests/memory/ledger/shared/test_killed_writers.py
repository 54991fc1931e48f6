"""Writers that are killed with SIGKILL at any moment: nothing acknowledged is lost, nothing is stored twice."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from dualbrain.memory.maintenance.verification import verify
from dualbrain.memory.state.derivation import derive_state
from tests.memory.ledger.shared.robots import Lab
from tests.memory.ledger.shared.test_shared_memory import recall
from tests.memory.memory_samples import INTERPRETER, NOW, REST_POSTURE, episode, open_memory

N_EPISODES = 25


def store_episodes(path: Path, life: str) -> None:
    """Store episodes and acknowledge each on stdout."""
    from dualbrain.memory.ledger.ledger import Ledger  # noqa: PLC0415 - for the child

    with Ledger(path, holder="a writer", now=NOW, timeout_s=20.0) as ledger:
        memory = open_memory(ledger)
        for i in range(N_EPISODES):
            name = f"{life}-{i}"
            memory.store(episode(name, recall=recall(memory)), REST_POSTURE, now=NOW)
            print(ledger.qualify(name), flush=True)  # noqa: T201 - the acknowledgement


def start(path: Path, life: str) -> subprocess.Popen[str]:
    command = [*INTERPRETER, "-m", "tests.memory.ledger.shared.test_killed_writers", str(path), life]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_killed_and_concurrent_writers_leave_one_chain_with_every_acknowledged_episode(lab: Lab) -> None:
    paths = {name: lab.path(name) for name in ("one", "two")}
    survivor, acknowledged = start(paths["two"], "long"), []
    for life in range(2):
        writer = start(paths["one"], f"life{life}")
        assert writer.stdout is not None
        acknowledged.append(writer.stdout.readline())
        time.sleep(0.03)
        os.kill(writer.pid, signal.SIGKILL)
        acknowledged += writer.stdout.readlines()
        writer.wait()
        writer.stdout.close()
    acknowledged += survivor.communicate(timeout=60)[0].splitlines(keepends=True)
    assert survivor.returncode == 0
    with lab.open("one") as first, lab.open("two") as second:
        memories = [open_memory(first), open_memory(second)]
        stored = [event.subject for event in first.events("episode")]
        assert len(stored) == len(set(stored))
        assert {line.strip() for line in acknowledged if line.endswith("\n")} <= set(stored)
        assert sum(name.startswith("two/") for name in stored) == N_EPISODES
        assert memories[0].weights() == memories[1].weights() == derive_state(first).weights()
        assert verify(first).is_intact


if __name__ == "__main__":
    store_episodes(Path(sys.argv[1]), sys.argv[2])
