"""A session: everything one run needs, opened in the order in which things can go wrong, closed whatever happens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np

from dualbrain import __version__, weights
from dualbrain.adaptation.serving.adapted import AdaptedPlanner
from dualbrain.adaptation.serving.opening import open_planner
from dualbrain.embodiment.body import load_body
from dualbrain.embodiment.site_file import read_site
from dualbrain.errors import InvalidSetup
from dualbrain.knowledge.library import Library
from dualbrain.knowledge.shipped import open_library
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.curation import note_uses
from dualbrain.memory.encoder import MiniLmEncoder
from dualbrain.memory.image import IMAGE_WEIGHTS, ImageEncoder
from dualbrain.memory.ledger import Ledger
from dualbrain.memory.picture import Picture
from dualbrain.memory.plasticity import Plasticity
from dualbrain.memory.posture import PostureLimits
from dualbrain.memory.runs import InterruptedRun
from dualbrain.memory.store import Memory, StoreReport
from dualbrain.planner.prompt import MAX_RECALLED, template_hash
from dualbrain.planner.protocol import Planner
from dualbrain.planner.registry import DEFAULT_PLANNER
from dualbrain.records import Episode, Passage
from dualbrain.runtime.charted import open_map, with_places
from dualbrain.runtime.consulting import consult
from dualbrain.runtime.counterfactual import Counterfactuals
from dualbrain.runtime.episode import Errand, Witness, run_episode
from dualbrain.runtime.given import GivenContract
from dualbrain.runtime.local_layer import LayerConfig, LocalLayer, Moment
from dualbrain.runtime.log import FlightLog
from dualbrain.runtime.recorder import Recorder
from dualbrain.runtime.simulated import SimulatedWorld
from dualbrain.runtime.storable import storable
from dualbrain.runtime.thinking import PLANNING_TIME, Clock, Thinking
from dualbrain.runtime.trace import Event, Trace
from dualbrain.safety.filter import SafetyFilter
from dualbrain.safety.native import kernel_hash
from dualbrain.safety.site import site_body, site_grants, site_obstacles
from dualbrain.skills.vocabulary import registry_of
from dualbrain.world.catalogue import open_scene
from dualbrain.world.open_plant import open_plant
from dualbrain.world.perception import Noise, Perception
from dualbrain.world.pictures import Camera
from dualbrain.world.scene_spec import save_scene
from dualbrain.world.task import goal_of

FILES = ("config.json", "scene.json", "episode.mcap", "episode.json", "report.html")
"""What a run leaves in its folder."""
ENCODER, TOKENIZER = "minilm-l6-v2-int8", "minilm-l6-v2-tokenizer"


@dataclass(frozen=True, slots=True)
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
    knowledge: Path | None = None
    consult: bool = False
    map: str = ""
    site: Path | None = None
    goal: str = ""
    measured: bool = False
    visuals: bool = True
    eyes: bool = False
    """Whether a picture of the scene is part of what memory compares (its image block)."""
    utility: bool = False
    """Whether the planner is asked again without each exemplar, to tell which memory was of use."""
    static: bool = False
    """Whether memory's weights stand still: recalled and stored alike, but nothing is learnt."""
    adapters: Path | None = None
    """The registry of adapters; None: the folder `adapters` beside the ledger."""


@dataclass(frozen=True, slots=True)
class Times:
    """The clocks, handed in from above: a monotonic one [s], and the date of the start (UTC, ISO 8601, and seconds).

    `pace(now)` may delay each tick of the simulation for people.
    """

    clock: Clock
    started: str
    now: Callable[[], float]
    pace: Callable[[float], None] | None = None


@dataclass(frozen=True, slots=True)
class Onlooker:
    """Who watches: events as they happen, moments of the control loop, the start of each phase."""

    event: Callable[[Event], None] = lambda event: None
    moment: Callable[[Moment], None] = lambda moment: None
    phase: Callable[[str], None] = lambda phase: None


@dataclass(slots=True)
class Finished:
    """What a run leaves: the episode, what memory changed, and the trace."""

    episode: Episode
    stored: StoreReport
    trace: Trace


class Session:
    """One robot, one scene, one planner, one memory."""

    def __init__(
        self, config: RunConfig, times: Times, environ: Mapping[str, str], planner: Planner | None = None
    ) -> None:
        """Open everything; raises `MissingPart`, `InvalidSetup` or `UnknownName` before anything has moved.

        A `planner` that is handed in serves this session and stays open; otherwise the configured one is opened.
        """
        out = config.out if config.out.name not in ("", "..") else config.out.resolve()  # a run needs a name
        self.config, self.times = replace(config, instruction=storable(config.instruction), out=out), times
        self._stack = ExitStack()
        self._interrupted = False
        try:
            self._open(environ, planner)
        except BaseException:
            self._stack.close()
            raise

    def _open(self, environ: Mapping[str, str], planner: Planner | None) -> None:
        config = self.config
        _check_folder(config.out)
        site = read_site(config.site) if config.site else None
        self.body = site_body(load_body(config.robot), site) if site else load_body(config.robot)
        self.standing = site_obstacles(self.body, site) if site else ()
        self.grants = site_grants(site, frozenset(registry_of(self.body).by_name)) if site else None
        self.spec = open_scene(config.scene, config.robot)
        goal = goal_of(config.goal, self.spec) if config.goal else None
        encoder = MiniLmEncoder(weights.locate(ENCODER, config.cache), weights.locate(TOKENIZER, config.cache))
        self._eyes = ImageEncoder(weights.locate(IMAGE_WEIGHTS, config.cache)) if config.eyes else None
        self.planner = planner or self._open_planner(environ)
        if planner is None:
            self._stack.callback(self.planner.close)
        config.out.mkdir(parents=True, exist_ok=True)
        config.ledger.parent.mkdir(parents=True, exist_ok=True)
        ledger = Ledger(config.ledger, holder=f"dualbrain run {config.out.name}", now=self.times.now())
        self._stack.callback(ledger.close)
        self.ledger = ledger
        self.library = self._open_library(encoder)
        rule = None if config.static else Plasticity()
        self.memory = Memory(ledger, encoder, MemoryConfig((PostureLimits.of(self.body),), plasticity=rule))
        if self.library is not None and config.map:
            self.spec = with_places(self.spec, *open_map(self.library, config.map))
        self.plant = open_plant(self.spec, self.body, visuals=config.visuals)
        perception = Perception(self.spec, Noise(), np.random.default_rng([config.seed, 1]))
        self.world = SimulatedWorld(self.plant, perception, goal=goal, pace=self.times.pace)
        self.interrupted: tuple[InterruptedRun, ...] = ()

    def _open_library(self, encoder: MiniLmEncoder) -> Library | None:
        """The documents, if something is to be taken from them."""
        asked = self.config.consult and self.config.contract is None
        if self.config.knowledge is None or not (asked or self.config.map):
            return None
        library = open_library(self.config.knowledge, encoder, now=self.times.now())
        self._stack.callback(library.close)
        return library

    def _open_planner(self, environ: Mapping[str, str]) -> Planner:
        if self.config.contract:
            return GivenContract(f"file {self.config.contract.name}", self.config.contract.read_bytes())
        prefixes = self.config.cache / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        key = environ.get("OPENAI_API_KEY", "")
        adapters = self.config.adapters or self.config.ledger.with_name("adapters")
        registry = registry_of(self.body)
        return open_planner(
            self.config.planner, self.config.cache, adapters=adapters, robot=self.body.name, registry=registry.hash,
            key=key, prefixes=prefixes,
        )  # fmt: skip

    def run(self, onlooker: Onlooker) -> Finished:
        """Run the instruction; the run folder holds config, scene, recording and episode when this returns."""
        config, out = self.config, self.config.out
        out.joinpath("config.json").write_bytes(
            msgspec.json.format(msgspec.json.encode(config, enc_hook=str), indent=2)
        )
        save_scene(self.spec, out / "scene.json")
        self.interrupted = self.ledger.start_run(out.name, {"instruction": config.instruction}, now=self.times.now())
        trace = Trace(self.body.n, self.body.width)
        with Recorder(out / "episode.mcap", trace, when_full="wait") as recorder:
            log = FlightLog(trace, recorder, onlooker.event)
            about = {"robot": config.robot, "guard": config.guard, "instruction": config.instruction}
            if config.site:
                about |= {"body": self.body, "standing": self.standing}
            recorder.episode(0.0, {**about, "versions": self._versions()})
            try:
                episode, stored = self._episode(log, onlooker)
            finally:
                self.plant.stop()
        episode = self._with_uses(episode)
        self.ledger.end_run({"outcome": episode.outcome.kind}, now=self.times.now())
        return Finished(episode, stored, trace)

    def interrupt(self) -> None:
        """A person wants the robot to stop: it brakes to rest, the drive goes off, and everything is recorded."""
        self._interrupted = True

    def _episode(self, log: FlightLog, onlooker: Onlooker) -> tuple[Episode, StoreReport]:
        config, world = self.config, self.world

        def phase_changed(phase: str, roles: dict[str, str | None]) -> None:
            world.allow(phase, roles)
            onlooker.phase(phase)

        layer = LocalLayer(
            self.body, self.plant, world, SafetyFilter(self.body, standing=self.standing), log,
            LayerConfig(guard=config.guard),
            watch=onlooker.moment, phase_changed=phase_changed,
            interrupted=lambda: self._interrupted, clock=lambda: self.plant.now,
        )  # fmt: skip
        given = config.contract is not None
        errand = Errand(
            config.out.name, self.times.started, config.instruction, config.seed, 1 if given else config.shots,
            exemplars=0 if given else MAX_RECALLED,
        )  # fmt: skip
        thinking = Thinking(self.times.clock, config.measured, 0.0 if given else PLANNING_TIME)
        witness = Witness(world.begin, world.judgement, self._versions(), self._picture)
        episode, stored = run_episode(
            errand, self.planner, self.memory, layer, thinking, witness, self._keep, now=self.times.now(),
            look_up=self._look_up, granted=self.grants,
        )  # fmt: skip
        for one in stored.changes:
            why = f"{one.memory}: {one.rule}d" if one.rule == "reinforce" else f"{one.memory}: suppressed"
            moved = {"episode_id": one.memory, "before": one.before, "after": one.after}
            log.note(layer.state.stamp, "memory", why, **moved)
        return episode, stored

    def _with_uses(self, episode: Episode) -> Episode:
        """The episode with what became of the memories in its prompt, if that is wanted; it is written down."""
        if not self.config.utility or self.config.contract is not None:
            return episode
        kept = self.config.ledger.with_name("counterfactuals")
        asking = Counterfactuals(self.planner, registry_of(self.body), kept)
        uses = asking.uses(episode, enough=lambda: self._interrupted)
        if uses:
            episode = msgspec.structs.replace(episode, uses=uses)
            self._keep(episode)
            note_uses(self.memory, episode.id, uses, now=self.times.now())
        return episode

    def _look_up(self, instruction: str, summary: str) -> tuple[Passage, ...]:
        """What the documents say to this, if they are to be asked."""
        if self.library is None or not self.config.consult:
            return ()
        return consult(self.library, instruction, summary, registry_of(self.body))

    def _picture(self) -> Picture | None:
        """What the camera at the front sees now, as features."""
        if self._eyes is None:
            return None
        with Camera(self.plant, width=320, height=240) as camera:
            return self._eyes.encode(camera.snap())

    def _keep(self, episode: Episode) -> None:
        self.config.out.joinpath("episode.json").write_bytes(
            msgspec.json.format(msgspec.json.encode(episode), indent=2)
        )

    def _versions(self) -> dict[str, str]:
        versions = {
            "dualbrain": __version__, "kernel": kernel_hash(), "mujoco": metadata.version("mujoco"),
            "prompt": template_hash(), "plant": self.plant.model_source, "filter": "on" if self.config.guard else "off",
        }  # fmt: skip
        if isinstance(self.planner, AdaptedPlanner):
            versions |= {"prompt": self.planner.template, "adapter": self.planner.card.id}
        return versions

    def __enter__(self) -> Self:
        """The session itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close everything."""
        self._stack.close()


def _check_folder(out: Path) -> None:
    """Refuse a run folder that holds a run: nothing that was recorded is written over."""
    found = sorted(name for name in FILES if (out / name).exists())
    if found:
        raise InvalidSetup("run folder", got=found, allowed="a folder without a run", fix=f"Name another --out. {out}")
    if out.exists() and not out.is_dir():
        raise InvalidSetup("run folder", got="a file", allowed="a folder", fix=f"Name another --out. {out}")
