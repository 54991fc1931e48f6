"""What a run is asked to be, who watches it, and what it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.memory.memory import StoreReport
from dualbrain.memory.plasticity.rule import EPSILON
from dualbrain.planner.registry import DEFAULT_PLANNER
from dualbrain.records import Episode
from dualbrain.runtime.planning_time import Clock


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """What one run is: written beside its result as `config.json`."""

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
    """How many contracts may be carried out: another one is planned after one that failed or was taken over."""
    knowledge: Path | None = None
    consult: bool = False
    map: str = ""
    site: Path | None = None
    goal: str = ""
    measured: bool = False
    visuals: bool = True
    image_memory: bool = False
    """Whether a picture of the scene is part of what memory compares (its image block)."""
    utility: bool = False
    """Whether the planner is asked again without each exemplar, to tell which memory was of use."""
    static: bool = False
    """Whether memory's weights stand still: recalled and stored alike, but nothing is learnt."""
    epsilon: float = EPSILON
    """ε of memory: with more Δ than this even a success lowers the weights of what led to it."""
    adapters: Path | None = None
    """The registry of adapters; None: the folder `adapters` beside the ledger."""


@dataclass(frozen=True, slots=True)
class Clocks:
    """The clocks, handed in from above: a monotonic one [s], and the date of the start (UTC, ISO 8601, and seconds).

    `pace(now)` may delay each tick of the simulation for people.
    """

    clock: Clock
    started: str
    now: Callable[[], float]
    pace: Callable[[float], None] | None = None


@dataclass(frozen=True, slots=True)
class RunObserver:
    """Who watches: events as they happen, moments of the control loop, the start of each phase."""

    on_event: Callable[[Event], None] = lambda event: None
    on_tick: Callable[[TickSnapshot], None] = lambda moment: None
    on_phase: Callable[[str], None] = lambda phase: None


@dataclass(slots=True)
class RunResult:
    """What a run leaves: the episode, what memory changed, the trace, and the tries before it that did not succeed."""

    episode: Episode
    store_report: StoreReport
    trace: Trace
    earlier_episodes: tuple[Episode, ...] = ()
