"""Entry points of the Python API: run an instruction, open a planner by name.

Like the commands, these functions use the folders of the user (`DUALBRAIN_HOME` and the XDG folders) where no other
folder is given.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.errors import ConfigurationError
from dualbrain.planner.registry import PACKAGED_PLANNER
from dualbrain.runtime.config import Clocks, RunObserver, RunResult, default_config
from dualbrain.runtime.session import Session

if TYPE_CHECKING:
    from dualbrain.planner.protocol import Planner
    from dualbrain.runtime.agent import Agent


def run(
    instruction: str,
    *,
    robot: str = "panda",
    scene: str = "0",
    planner: str | Planner = PACKAGED_PLANNER,
    agent: Agent | None = None,
    contract: Path | None = None,
    goal: str = "",
    guard: bool = True,
    seed: int = 0,
    out: Path | None = None,
    ledger: Path | None = None,
    observer: RunObserver = RunObserver(),
) -> RunResult:
    """Run one instruction on a simulated robot, in lockstep, and return the episode with its trace.

    `robot` is a name or the folder of an imported robot, `scene` a number, FAMILY:SEED or a scene file, `planner` a
    name as for `dualbrain run --planner` or a planner object. An `agent` replaces `planner` and the memory; its planner
    and memory stay open. With a `contract` file no planner is asked. `goal` is the criterion of success on ground
    truth, by default that of the instruction, or without one that of the contract. `guard` False writes nominal
    controls unfiltered, for comparison in simulation only. The run folder `out` (a new folder in `runs/` by default)
    holds the configuration, the scene, the recording and the episode. The memory is the file `ledger`, by default a new
    one in the run folder; with an `agent` this file records only the start and the end of the run, and must not be the
    ledger of the agent's memory.

    Raises:
        ConfigurationError: an argument has no valid value, `out` holds a run already, or both `agent` and `contract`
            are given.
        UnknownNameError: there is no such robot, scene or planner.
        MissingDependencyError: model weights or an optional package are missing.
    """
    if agent is not None and contract is not None:
        raise ConfigurationError.stating(
            "Both an agent and a contract are given, but a run with a contract asks no planner.",
            fix="Name only one of them.",
        )
    asked = planner if agent is None else agent.planner
    name, given = (asked, None) if isinstance(asked, str) else (asked.name, asked)
    config = default_config(instruction, out=out)
    config = replace(
        config,
        ledger=ledger or config.out / "ledger.sqlite",
        knowledge=None,
        robot=robot,
        scene=scene,
        planner=name,
        contract=contract,
        goal=goal,
        guard=guard,
        seed=seed,
        visuals=False,
    )
    started = datetime.now(UTC).isoformat(timespec="seconds")
    clocks = Clocks(time.monotonic, started, time.time)
    with Session(config, clocks, os.environ, None if contract else given, agent=agent) as session:
        return session.run(observer)


def open_planner(name: str, *, robot: str = "panda") -> Planner:
    """The planner called `name` for a `robot`, ready to propose; the caller closes it.

    `name` is a packaged or registered adapter, a model of `dualbrain models list`, a GGUF file, or the address of an
    OpenAI-compatible server (its key is read from `OPENAI_API_KEY`).
    Raises `ConfigurationError`, `UnknownNameError`, `MissingDependencyError` and `ChecksumError`.
    """
    from dualbrain.adaptation.serving.open_planner import open_planner as open_by_name  # noqa: PLC0415  (heavy)
    from dualbrain.grounding.vocabulary import load_skill_registry  # noqa: PLC0415

    return open_by_name(
        name,
        cache_folder(),
        adapters=dualbrain_home() / "adapters",
        robot=robot,
        registry=load_skill_registry(robot).hash,
        key=os.environ.get("OPENAI_API_KEY", ""),
    )
