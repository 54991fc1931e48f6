"""A cortex in a process of its own that is about to fail: commands a pick and place, and keeps writing its ledger.

    doomed_cortex.py SOCKET KEYS LEDGER HOW WAITS

It says "running" (or, with WAITS 0, "written" as soon as its contract has left, before any answer), and "stored NAME"
after each episode that the ledger has acknowledged. At a line on standard input it floods, or talks rubbish.
"""

from __future__ import annotations

import sys
import time
from itertools import count
from pathlib import Path
from threading import Lock, Thread

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from dualbrain.control.gatekeeper.protocol.authentication import open_keys  # noqa: E402
from dualbrain.control.gatekeeper.protocol.client import GatekeeperLink  # noqa: E402
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder  # noqa: E402
from dualbrain.memory.ledger.ledger import Ledger  # noqa: E402
from dualbrain.memory.memory import Memory  # noqa: E402
from experiments.memory.synthetic_episodes import CONFIG, REGISTRY, REST, ROBOT, START, made_up  # noqa: E402
from tests.control.gatekeeper.commander_process import contract, flood, rubbish  # noqa: E402

EVERY = 0.03
"""Pause between two episodes [s]."""
SPEAKING = Lock()


def say(line: str) -> None:
    """One whole line, at once."""
    with SPEAKING:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def remember(path: Path) -> None:
    """Store made-up episodes, each with what it recalled, until the process ends."""
    with Ledger(path, holder="doomed", now=START) as ledger:
        memory = Memory(ledger, HashingEncoder(32), CONFIG)
        for number in count():
            recall = memory.recall("grasp the cube", "cube: object", REST, ROBOT, REGISTRY, k=3)
            memory.store(made_up(f"d-{number}", recall=recall), REST, now=START)
            say(f"stored d-{number}")
            time.sleep(EVERY)


def main(path: str, keys: str, ledger: str, how: str, waits: str) -> None:
    """Command, remember, wait for the end."""
    Thread(target=remember, args=(Path(ledger),), daemon=True).start()
    link = GatekeeperLink(Path(path), open_keys(Path(keys)), "planner")
    version = link.look().scene.version
    if waits == "1":
        link.propose(contract(), version)
        say("running")
    else:
        say("ready")
        sys.stdin.readline()
        link.hand_in(contract(), version)
        say("written")
    sys.stdin.readline()
    if how in ("flood", "rubbish"):
        {"flood": flood, "rubbish": rubbish}[how](link)
    time.sleep(60.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
