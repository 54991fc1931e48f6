"""Planner, memory and run folders of an agent's robot, opened in the thread that uses them."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import msgspec

from dualbrain.adaptation.serving.open_planner import planner_provenance
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture, PostureLimits
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory, StoreReport
from dualbrain.planner.protocol import Planner
from dualbrain.records import Episode
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.agent import EpisodicMemory, NoMemory
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.skills.registry import skill_registry

HOLDER = "dualbrain agent interface"
"""Name of the writer of the ledger."""
LOCK_TIMEOUT = 5.0
"""Longest wait for another writer of the ledger [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentResources:
    """The open `planner` (None without one), the `memory`, and the `versions` that episodes record."""

    planner: Planner | None
    memory: EpisodicMemory
    versions: dict[str, str]
    stack: ExitStack

    def close(self) -> None:
        """Close planner and memory."""
        self.stack.close()


def open_agent_resources(
    robot_model: RobotModel, *, planner: str | Planner | None, ledger: Path | None, runs: Path | None
) -> AgentResources:
    """Open the planner by its name, the memory at `ledger`, and the folder `runs`; each may be absent.

    A planner that is passed as an object stays open. Raises `ConfigurationError`, `UnknownNameError` and
    `MissingDependencyError`.
    """
    stack = ExitStack()
    try:
        opened = _open_planner(planner, robot_model, stack) if isinstance(planner, str) else planner
        memory = _open_memory(ledger, robot_model, stack) if ledger else NoMemory()
        versions = {"dualbrain": metadata.version("dualbrain"), "kernel": kernel_hash()}
        versions |= planner_provenance(opened) if opened else {}
        return AgentResources(
            planner=opened, memory=SavingMemory(memory, runs) if runs else memory, versions=versions, stack=stack
        )
    except BaseException:
        stack.close()
        raise


class SavingMemory:
    """A memory whose episodes are saved in a folder of their own before they are stored."""

    def __init__(self, memory: EpisodicMemory, runs: Path) -> None:
        """Store in `memory`, and save each episode as `runs`/ID/episode.json."""
        self._memory, self._runs = memory, runs
        self.retrieve = memory.retrieve

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Save the episode, then store it; see `EpisodicMemory.store`."""
        folder = self._runs / episode.id
        create_private_folder(folder)
        write_atomically(folder / "episode.json", msgspec.json.format(msgspec.json.encode(episode), indent=2))
        return self._memory.store(episode, state, now=now, image=image)


def _open_planner(name: str, robot_model: RobotModel, stack: ExitStack) -> Planner:
    from dualbrain.adaptation.serving.open_planner import open_planner  # noqa: PLC0415  (heavy)

    prefixes = cache_folder() / "prefixes"
    create_private_folder(prefixes)
    planner = open_planner(
        name,
        cache_folder(),
        adapters=dualbrain_home() / "adapters",
        robot=robot_model.name,
        registry=skill_registry(robot_model).hash,
        key=os.environ.get("OPENAI_API_KEY", ""),
        prompt_cache=prefixes,
    )
    stack.callback(planner.close)
    return planner


def _open_memory(path: Path, robot_model: RobotModel, stack: ExitStack) -> Memory:
    ledger = Ledger(path, holder=HOLDER, now=time.time(), timeout_s=LOCK_TIMEOUT)
    stack.callback(ledger.close)
    limits = (PostureLimits.from_model(robot_model),)
    return Memory(ledger, MiniLmEncoder.from_cache(cache_folder()), MemoryConfig(limits=limits))
