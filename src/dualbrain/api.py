"""Entry points of the Python API: run an instruction, open a planner by name.

Like the commands, these functions use the folders of the user (`DUALBRAIN_HOME` and the XDG folders) where no other
folder is given.
"""

from __future__ import annotations

import os
import time
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING

from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.runtime.config import Clocks, RunConfig, RunObserver, RunResult
from dualbrain.runtime.session import Session

if TYPE_CHECKING:
    from dualbrain.planner.protocol import Planner


def run(
    instruction: str,
    *,
    robot: str = "panda",
    scene: str = "0",
    planner: str | Planner = "base-135m",
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
    name as for `dualbrain run --planner` or a planner object. With a `contract` file no planner is asked. `goal` is the
    criterion of success on ground truth, by default the goal of the contract. `guard` False writes nominal controls
    unfiltered, for comparison in simulation only. The run folder `out` (a new folder in `runs/` by default) holds the
    configuration, the scene, the recording and the episode. The memory is the file `ledger`, by default a new one in
    the run folder. Raises `ConfigurationError`, `UnknownNameError` and `MissingDependencyError` before any motion.
    """
    started = datetime.now(UTC)
    folder = out or Path("runs") / f"{started:%Y%m%dT%H%M%SZ}-{token_hex(3)}"
    name = planner if isinstance(planner, str) else planner.name
    config = RunConfig(
        instruction=instruction,
        out=folder,
        ledger=ledger or folder / "ledger.sqlite",
        cache=cache_folder(),
        adapters=dualbrain_home() / "adapters",
        robot=robot,
        scene=scene,
        planner=name,
        contract=contract,
        goal=goal,
        guard=guard,
        seed=seed,
        visuals=False,
    )
    clocks = Clocks(time.monotonic, started.isoformat(timespec="seconds"), time.time)
    given = None if isinstance(planner, str) else planner
    with Session(config, clocks, os.environ, given) as session:
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
