"""Ledgers of runs: each episode leaves a complete folder, so a run that was killed continues with the next episode."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dualbrain.core.encoder import Encoder
from dualbrain.core.storage.atomic_files import fsync_folder, fsync_tree
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.core.storage.resumable_steps import exclusive_folder
from dualbrain.evaluation.episodes.case_runner import load_cached_robot
from dualbrain.evaluation.protocol.method import Method
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.hebbian_update import Penalty, Plasticity

LEDGER_FILE = "ledger.sqlite"
FIRST_EPISODE_TIME_S, EPISODE_INTERVAL_S = 1_795_000_000.0, 240.0
"""Fixed date of a run's first episode [s since 1970 UTC] and interval between episodes [s].

Results therefore do not depend on the day of the run.
"""
MAX_DELTA = 2.0
"""Upper bound of δ and Δ (paper 4.4): with this ε, every Δ is small enough."""


def episode_time(order: int) -> float:
    """The date of episode number `order` of a run [s since 1970 UTC]."""
    return FIRST_EPISODE_TIME_S + order * EPISODE_INTERVAL_S


def plasticity_rule(method: Method, epsilon: float) -> Plasticity | None:
    """The rule by which the memory weights of `method` learn: None without learning, by (r, Δ), or by r alone.

    Learning by r alone uses an ε that every Δ meets and a constant penalty.
    """
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
        """The folder that the first `episodes` episodes left."""
        return self.path / f"after-{episodes:04d}"

    @contextmanager
    def open_episode(self, order: int, start: Path | None) -> Iterator[Path]:
        """Path of the ledger for episode number `order`: a copy of the previous ledger, for the first one of `start`.

        The copy becomes the folder after this episode only if the body raises nothing, and then survives a power
        failure. A worker whose parent was killed first finishes its episode; another worker waits for that.
        """
        before = self.folder_after(order) if order else start
        partial = self.path / "partial"
        with exclusive_folder(self.path):
            shutil.rmtree(partial, ignore_errors=True)
            if before is not None:
                shutil.copytree(before, partial)
            else:
                create_private_folder(partial)
            yield partial / LEDGER_FILE
            shutil.rmtree(self.folder_after(order + 1), ignore_errors=True)
            fsync_tree(partial)
            partial.rename(self.folder_after(order + 1))
            fsync_folder(self.path)

    def first_episode_to_run(self, done: int) -> int:
        """Number of the episode with which a run continues of which `done` episodes are in the log.

        It is `done` if the ledger after these episodes exists; else the run continues from the newest ledger before,
        or begins again.
        """
        return next((order for order in range(done, 0, -1) if self.folder_after(order).is_dir()), 0)

    def remove_old_ledgers(self, episodes: int) -> None:
        """Remove all ledgers of a finished run but the last two: the last row may not have been logged yet.

        If more rows were lost, the run begins again (`first_episode_to_run`).
        """
        for old in self.path.glob("after-*"):
            if old not in (self.folder_after(episodes), self.folder_after(episodes - 1)):
                shutil.rmtree(old)


@contextmanager
def open_memory(
    ledger: Path, robot: str, encoder: Encoder, plasticity: Plasticity | None, now: float
) -> Iterator[Memory]:
    """The memory with its ledger at `ledger`, opened for writing at time `now` [s since 1970 UTC]."""
    config = MemoryConfig(limits=(PostureLimits.from_model(load_cached_robot(robot)),), plasticity=plasticity)
    with Ledger(ledger, holder="dualbrain evaluate", now=now) as opened:
        yield Memory(opened, encoder, config)


def folder_name(name: str) -> str:
    """`name` as the name of a folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name)
