"""The control tick in real time: a gatekeeper at 1 kHz for ten minutes with recorder, watcher and contracts."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.runtime.gatekeeper.client import GatekeeperLink
from dualbrain.runtime.gatekeeper.messages import Refused
from dualbrain.runtime.gatekeeper.seals import open_keys
from dualbrain.runtime.gatekeeper.spawn import Plan, Process
from dualbrain.runtime.vocabulary import PLANNER, vocabulary
from dualbrain.world.catalogue import open_scene
from proofs.closed_loop import errand
from proofs.proof import Options, Row, Unit

MINUTES = 10
SCENE = "tabletop:1"


class Tick:
    """1 kHz, measured: intervals, work, latency, late ticks, missed states."""

    name = "tick"
    claim = "Ten minutes of the control tick at 1 kHz in real time, with recorder, a watcher and contracts: measured."

    def units(self, options: Options) -> list[Unit]:
        """One a minute, each a gatekeeper of its own."""
        del options
        return [Unit(f"minute {minute}", {"minute": minute}) for minute in range(MINUTES)]

    def run(self, about: dict[str, Any]) -> Row:
        """A minute of errands, one after the other."""
        del about
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            plan = Plan(
                "panda", open_scene(SCENE), str(folder / "s"), str(folder / "keys"), recording=str(folder / "e.mcap"),
                punctuality=str(folder / "p.json"),
            )  # fmt: skip
            process = Process(plan)
            contracts = _errands(folder, time.monotonic() + 60.0)
            process.stop()
            found = json.loads((folder / "p.json").read_bytes())
        found["bins"] = {str(20 * k): count for k, count in enumerate(found["bins"]) if count}
        return {**found, "contracts": contracts}

    def brief(self, row: Row) -> str:
        """For the progress line."""
        return f"{row['ticks']} ticks, median {1e3 * row['interval'][0]:.2f} ms, longest {1e3 * row['interval'][3]:.1f}"

    def report(self, rows: list[Row]) -> list[str]:
        """All minutes together."""
        ticks, late, missed = (sum(row[name] for row in rows) for name in ("ticks", "late", "missed"))
        lines = [
            f"{ticks} ticks; {missed} states missed, {late} late (over 1 ms of work; {late / max(1, ticks):.2%}).",
            "", "| | median | 99 % | 99.9 % | longest |", "|---|---|---|---|---|",
        ]  # fmt: skip
        for name in ("interval", "work", "latency"):
            worst = [max(row[name][k] for row in rows) for k in range(4)]
            lines.append(f"| {name}, worst minute | " + " | ".join(f"{1e3 * value:.2f} ms" for value in worst) + " |")
        return lines


def _errands(folder: Path, until: float) -> int:
    keys, count = open_keys(folder / "keys"), 0
    link = GatekeeperLink(folder / "s", keys, PLANNER, watch=lambda message: None)
    registry = vocabulary("panda")
    context = {"robot": registry.robot, "registry": registry.hash}
    while time.monotonic() < until:
        text = {"id": f"c-{count:04d}", "context": context, "action_sequence": errand(speed=0.3)}
        answer = link.propose(msgspec.json.encode(text), link.look().scene.version)
        if isinstance(answer, Refused) or answer.rejected is not None:
            time.sleep(0.5)
            continue
        link.ended(60.0)
        count += 1
    link.close()
    return count
