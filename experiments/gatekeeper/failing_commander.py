"""A commander process that will fail: it commands a pick and place, and writes episodes to its ledger all the time.

    failing_commander.py SOCKET KEYS LEDGER FAILURE WAITS

It prints "running" (with WAITS 0: "written" as soon as it has sent its contract, before any answer), and
"stored NAME" after each episode whose storage the ledger has acknowledged. After a line on standard input it floods
the socket (FAILURE "flood") or sends malformed bytes (FAILURE "rubbish").
"""

from __future__ import annotations

import sys
import time
from itertools import count
from pathlib import Path
from threading import Lock, Thread

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from dualbrain.control.gatekeeper.protocol.authentication import load_keys  # noqa: E402
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient  # noqa: E402
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder  # noqa: E402
from dualbrain.memory.ledger.ledger import Ledger  # noqa: E402
from dualbrain.memory.memory import Memory  # noqa: E402
from experiments.gatekeeper.commander_messages import contract_bytes, send_flood, send_malformed_bytes  # noqa: E402
from experiments.memory.synthetic_episodes import CONFIG, REGISTRY, REST_POSTURE, ROBOT, START_TIME, synthetic_episode  # noqa: E402

EPISODE_INTERVAL_S = 0.03
"""Wait between two stored episodes [s]."""
OUTPUT_LOCK = Lock()


def print_line(line: str) -> None:
    """Print one line and flush it."""
    with OUTPUT_LOCK:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def write_episodes(path: Path) -> None:
    """Store synthetic episodes, each with the context that it retrieved, until the process ends."""
    with Ledger(path, holder="failing commander", now=START_TIME) as ledger:
        memory = Memory(ledger, HashingEncoder(32), CONFIG)
        for number in count():
            recall = memory.retrieve("grasp the cube", "cube: object", REST_POSTURE, ROBOT, REGISTRY, k=3)
            memory.store(synthetic_episode(f"d-{number}", recall=recall), REST_POSTURE, now=START_TIME)
            print_line(f"stored d-{number}")
            time.sleep(EPISODE_INTERVAL_S)


def main(path: str, keys: str, ledger: str, failure: str, waits: str) -> None:
    """Send the contract, store episodes, fail on request."""
    Thread(target=write_episodes, args=(Path(ledger),), daemon=True).start()
    link = GatekeeperClient(Path(path), load_keys(Path(keys), ("planner",)), "planner")
    version = link.request_scene().scene.version
    if waits == "1":
        link.propose(contract_bytes(), version)
        print_line("running")
    else:
        print_line("ready")
        sys.stdin.readline()
        link.submit(contract_bytes(), version)
        print_line("written")
    sys.stdin.readline()
    if failure in ("flood", "rubbish"):
        {"flood": send_flood, "rubbish": send_malformed_bytes}[failure](link)
    time.sleep(60.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
