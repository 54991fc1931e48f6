"""Configuration, clocks, observers and result of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex

import msgspec

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.paths import cache_folder, dualbrain_home, secure_home
from dualbrain.knowledge.document import ConsultedDocuments
from dualbrain.memory.memory import StoreReport
from dualbrain.memory.plasticity.hebbian_update import EPSILON
from dualbrain.planner.backends.key_redaction import public_planner
from dualbrain.planner.registry import DEFAULT_PLANNER
from dualbrain.records import Attempt, Episode
from dualbrain.runtime.planning.planning_time import Clock

STORED_NAMES = {"image_memory": "eyes"}
"""Names in `config.json` of the fields of a configuration, where they differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """Configuration of one run, which is stored as `config.json` in the run folder."""

    instruction: str
    out: Path
    ledger: Path
    cache: Path
    robot: str = "panda"
    scene: str = "0"
    planner: str = DEFAULT_PLANNER
    contract: Path | None = None
    guard: bool = True
    seed: int = 0
    shots: int = 2
    tries: int = 1
    """Maximum number of executed contracts; another one is planned after one that failed or was taken over."""
    knowledge: Path | None = None
    consult: ConsultedDocuments = "site"
    """Documents at `knowledge` whose passages enter the prompt of a planner that reads them."""
    map: str = ""
    site: Path | None = None
    goal: str = ""
    measured: bool = False
    visuals: bool = True
    image_memory: bool = False
    """Whether memory also compares images of the scenes."""
    utility: bool = False
    """Whether the planner plans again without each exemplar, to determine which memory was used."""
    static: bool = False
    """Whether the weights of memory are constant: episodes are retrieved and stored, but no weight is updated."""
    epsilon: float = EPSILON
    """Intervention threshold ε: a successful episode with Δ > ε lowers the weights of the memories it used."""
    unrecorded: bool = False
    """Whether the arm may move on if the recording cannot be written."""
    image: bool = False
    """Whether the planner gets the image of the simulated camera; it must take images."""
    after: Path | None = None
    """Run folder whose end is the beginning of this run, instead of `scene`."""
    adapters: Path | None = None
    """Folder of the adapter registry; None: the folder `adapters` beside the ledger."""
    planner_threads: int = 1
    """Processor threads of a model that runs in llama.cpp or torch; 1 beside a control loop in real time."""
    retry_when_busy: bool = False
    """Whether a contract is tried again that stopped because this machine was too busy for a robot in real time."""
    reuse_contracts: bool = False
    """Whether a contract that succeeded in this place answers instead of the planner."""
    target: str = ""
    """Emulated board on which the filter runs, in lockstep with the simulation; "" runs it in this process."""

    def encode(self) -> bytes:
        """The content of `config.json`, with the field names of earlier versions; newer fields only if they are set.

        The address of a planner is stored without user name, password and query.
        """
        fields = msgspec.to_builtins(self, enc_hook=str) | {"planner": public_planner(self.planner)}
        if not self.unrecorded:
            del fields["unrecorded"]
        if not self.image:
            del fields["image"]
        if self.after is None:
            del fields["after"]
        if self.planner_threads == 1:
            del fields["planner_threads"]
        if not self.retry_when_busy:
            del fields["retry_when_busy"]
        if not self.reuse_contracts:
            del fields["reuse_contracts"]
        if not self.target:
            del fields["target"]
        stored = {STORED_NAMES.get(name, name): value for name, value in fields.items()}
        return msgspec.json.format(msgspec.json.encode(stored), indent=2)


def default_config(instruction: str, *, out: Path | None = None, ledger: Path | None = None) -> RunConfig:
    """The configuration of a run in the user's own folders; by default in a new run folder."""
    started = datetime.now(UTC)
    secure_home()
    return RunConfig(
        instruction=instruction,
        out=out or Path("runs") / f"{started:%Y%m%dT%H%M%SZ}-{token_hex(3)}",
        ledger=ledger or dualbrain_home() / "ledger.sqlite",
        cache=cache_folder(),
        knowledge=dualbrain_home() / "knowledge.sqlite",
        adapters=dualbrain_home() / "adapters",
    )


@dataclass(frozen=True, slots=True)
class Clocks:
    """The clocks of a run.

    `clock` is monotonic [s]. `started` is the date of the start (UTC, ISO 8601), `now` returns the date in [s, 1970
    UTC]. `pace(now)` may delay each tick of the simulation to real time.
    """

    clock: Clock
    started: str
    now: Callable[[], float]
    pace: Callable[[float], None] | None = None


@dataclass(frozen=True, slots=True)
class RunObserver:
    """Callbacks of a run: each event, snapshots of the control loop, start of each phase, each checked proposal."""

    on_event: Callable[[Event], None] = lambda event: None
    on_tick: Callable[[TickSnapshot], None] = lambda snapshot: None
    on_phase: Callable[[str], None] = lambda phase: None
    on_attempt: Callable[[Attempt], None] = lambda attempt: None


@dataclass(slots=True)
class RunResult:
    """Result of a run: the episode, the changes of memory, the trace, and the earlier tries, which did not succeed."""

    episode: Episode
    store_report: StoreReport
    trace: Trace
    earlier_episodes: tuple[Episode, ...] = ()
