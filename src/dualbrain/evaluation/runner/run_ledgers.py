"""The ledgers of runs: each episode leaves a whole folder, so that a run that was killed goes on with the next one."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dualbrain.core.storage.resumable_steps import exclusive_folder
from dualbrain.evaluation.episodes.case_runner import load_cached_robot
from dualbrain.evaluation.protocol.method import Method
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.embedding.text_encoder import Encoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.rule import Penalty, Plasticity

LEDGER_FILE = "ledger.sqlite"
FIRST_EPISODE_TIME_S, EPISODE_INTERVAL_S = 1_795_000_000.0, 240.0
"""Made-up date of a run's first episode [s, 1970 UTC] and time between two: results do not depend on the day."""
MAX_DELTA = 2.0
"""δ, and so Δ, is never more than this (paper 4.4): an ε that every Δ meets."""


def episode_time(order: int) -> float:
    """The date of the episode number `order` of a run."""
    return FIRST_EPISODE_TIME_S + order * EPISODE_INTERVAL_S


def plasticity_rule(method: Method, epsilon: float) -> Plasticity | None:
    """How the weights of `method` learn: not at all, by (r, Δ), or by r alone (ε that all meet, a constant penalty)."""
    if method.memory != "dynamic":
        return None
    if method.signal == "success":
        return Plasticity(epsilon=MAX_DELTA, g=Penalty(floor=1.0))
    return Plasticity(epsilon=epsilon * method.epsilon_factor)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of one run: `after-0003` holds the ledger after three episodes."""

    path: Path

    def folder_after(self, episodes: int) -> Path:
        """What the first `episodes` episodes left."""
        return self.path / f"after-{episodes:04d}"

    @contextmanager
    def open_episode(self, order: int, start: Path | None) -> Iterator[Path]:
        """A copy of what the episodes before `order` left (or of `start`), which counts only if nothing is raised.

        A worker whose parent was killed ends its episode first; whoever follows waits for that.
        """
        before = self.folder_after(order) if order else start
        partial = self.path / "partial"
        with exclusive_folder(self.path):
            shutil.rmtree(partial, ignore_errors=True)
            if before is not None:
                shutil.copytree(before, partial)
            else:
                partial.mkdir()
            yield partial / LEDGER_FILE
            shutil.rmtree(self.folder_after(order + 1), ignore_errors=True)
            partial.rename(self.folder_after(order + 1))

    def remove_old_ledgers(self, episodes: int) -> None:
        """The run is over: its last ledger stays, and that before it, in case the last episode was not written down."""
        for old in self.path.glob("after-*"):
            if old not in (self.folder_after(episodes), self.folder_after(episodes - 1)):
                shutil.rmtree(old)


@contextmanager
def open_memory(
    ledger: Path, robot: str, encoder: Encoder, plasticity: Plasticity | None, now: float
) -> Iterator[Memory]:
    """The memory whose ledger lies at `ledger`, for writing."""
    config = MemoryConfig(limits=(PostureLimits.from_model(load_cached_robot(robot)),), plasticity=plasticity)
    with Ledger(ledger, holder="dualbrain evaluate", now=now) as opened:
        yield Memory(opened, encoder, config)


def folder_name(name: str) -> str:
    """`name` as a folder's name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name)
