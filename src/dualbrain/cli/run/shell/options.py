"""Options of the shell, and its record of each instruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.knowledge.document import ConsultedDocuments


@dataclass(frozen=True, slots=True, kw_only=True)
class ShellOptions:
    """Options that every instruction of a shell shares; their meaning is that of `dualbrain run`.

    `out` is the folder in which each instruction gets a run folder.
    """

    robot: str = "panda"
    scene: str = "0"
    after: Path | None = None
    planner: str = ""
    site: Path | None = None
    out: Path = Path("runs")
    ledger: Path | None = None
    seed: int = 0
    tries: int = 2
    consult: ConsultedDocuments = "site"
    reuse_contracts: bool = False
    live_view: bool = True
    port: int = 8080
    real_time: bool = False
    speed_scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryEntry:
    """One instruction: its words, the outcome in words, the exit code that `dualbrain run` would have, its folder."""

    instruction: str
    outcome: str
    code: int
    folder: Path | None
