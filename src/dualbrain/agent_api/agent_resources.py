"""Planner, memory and run folders of an agent's robot, opened in the thread that uses them."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from dualbrain.adaptation.serving.open_planner import planner_provenance
from dualbrain.agent_api.saved_runs import SavedRuns, SavingMemory
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.grounding.instruction.clauses.clause_classifier import ClauseClassifier, find_clause_classifier
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.planner.prompt.full_prompt import conditional_text_hash
from dualbrain.planner.protocol import Planner
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
    """The open `planner` (None without one), the `memory`, and the `versions` that episodes record.

    `runs` are the run folders, in which the memory saves each episode; None without a folder for them.
    """

    planner: Planner | None
    memory: EpisodicMemory
    runs: SavedRuns | None
    versions: dict[str, str]
    stack: ExitStack
    clause_classifier: ClauseClassifier | None = None

    def close(self) -> None:
        """Close planner and memory."""
        self.stack.close()


def open_agent_resources(
    robot_model: RobotModel,
    *,
    planner: str | Planner | None,
    ledger: Path | None,
    runs: Path | None,
    posture_limits: PostureLimits,
) -> AgentResources:
    """Open the planner by its name, the memory at `ledger`, and the folder `runs`; each may be absent.

    `posture_limits` normalise the postures of the memory; they are those of the robot without a site file. A planner
    that is passed as an object stays open. Raises `ConfigurationError`, `UnknownNameError` and
    `MissingDependencyError`.
    """
    stack = ExitStack()
    try:
        opened = _open_planner(planner, robot_model, stack) if isinstance(planner, str) else planner
        memory = _open_memory(ledger, posture_limits, stack) if ledger else NoMemory()
        versions = {"dualbrain": metadata.version("dualbrain"), "kernel": kernel_hash()}
        if opened:
            versions |= {"beside": conditional_text_hash()} | planner_provenance(opened)
        saved = SavedRuns(runs, robot_model) if runs else None
        return AgentResources(
            planner=opened,
            memory=SavingMemory(memory, saved) if saved else memory,
            runs=saved,
            versions=versions,
            stack=stack,
            clause_classifier=find_clause_classifier(cache_folder()) if opened else None,
        )
    except BaseException:
        stack.close()
        raise


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


def _open_memory(path: Path, posture_limits: PostureLimits, stack: ExitStack) -> Memory:
    ledger = Ledger(path, holder=HOLDER, now=time.time(), timeout_s=LOCK_TIMEOUT)
    stack.callback(ledger.close)
    return Memory(ledger, MiniLmEncoder.from_cache(cache_folder()), MemoryConfig(limits=(posture_limits,)))
