"""A session: everything one run needs, opened in the order in which things can go wrong, closed whatever happens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np

from dualbrain import __version__
from dualbrain.adaptation.serving.open_planner import open_planner, origin
from dualbrain.contracts.registry import narrows
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from dualbrain.core import weights
from dualbrain.core.text import storable
from dualbrain.errors import InvalidSetup
from dualbrain.grounding.document_retrieval import consult
from dualbrain.grounding.map_overlay import charted
from dualbrain.knowledge.builtin_documents import open_library
from dualbrain.knowledge.library import Library
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_encoder import IMAGE_WEIGHTS, ImageEncoder
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.maintenance.edits import note_uses
from dualbrain.memory.memory import Memory, StoreReport
from dualbrain.memory.plasticity.rule import Plasticity
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, beside_hash, template_hash
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import GivenContract
from dualbrain.records import Episode, Passage, Setback
from dualbrain.robots.loader import load_body
from dualbrain.robots.site_config import read_site
from dualbrain.runtime.config import Finished, Onlooker, RunConfig, Times
from dualbrain.runtime.counterfactual import Counterfactuals
from dualbrain.runtime.episode import Errand, Witness, run_episode
from dualbrain.runtime.planning_time import PLANNING_TIME, Thinking
from dualbrain.runtime.replanning import Tried, tried
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.safety.integration.site import site_body, site_grants, site_obstacles
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import save_scene
from dualbrain.simulation.tasks.multi_goal import errand_of
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import registry_of

FILES = ("config.json", "scene.json", "episode.mcap", "episode.json", "report.html")
"""What a run leaves in its folder."""
__all__ = ["FILES", "Finished", "Onlooker", "RunConfig", "Session", "Times"]


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
        self._kept: list[str] = []
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
        encoder = MiniLmEncoder.fetched(config.cache)
        self.library = self._open_library(encoder)
        if self.library is not None and config.map:
            self.spec = charted(self.spec, self.body, self.library, config.map)
        goal = errand_of(config.goal, self.spec) if config.goal else None
        self._eyes = ImageEncoder(weights.locate(IMAGE_WEIGHTS, config.cache)) if config.eyes else None
        self.planner = planner or self._open_planner(environ)
        if planner is None:
            self._stack.callback(self.planner.close)
        config.out.mkdir(parents=True, exist_ok=True)
        config.ledger.parent.mkdir(parents=True, exist_ok=True)
        ledger = Ledger(config.ledger, holder=f"dualbrain run {config.out.name}", now=self.times.now())
        self._stack.callback(ledger.close)
        self.ledger = ledger
        rule = None if config.static else Plasticity(epsilon=config.epsilon)
        self.memory = Memory(ledger, encoder, MemoryConfig((PostureLimits.of(self.body),), plasticity=rule))
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
        registry, own = registry_of(self.body), registry_of(load_body(self.config.robot))
        return open_planner(
            self.config.planner, self.config.cache, adapters=adapters, robot=self.body.name, registry=registry.hash,
            key=key, prefixes=prefixes, narrowed={registry.hash: own.hash} if narrows(registry, own) else {},
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
                tries = self._episodes(log, onlooker)
            finally:
                self.plant.stop()
        return self._finished(tries, trace)

    def _finished(self, tries: tuple[Tried, ...], trace: Trace) -> Finished:
        """The end of a run: what its last try was, after what became of the memories in its prompt."""
        *earlier, (episode, stored) = tries
        episode = self._with_uses(episode)
        self.ledger.end_run({"outcome": episode.outcome.kind}, now=self.times.now())
        return Finished(episode, stored, trace, tuple(one for one, _ in earlier))

    def interrupt(self) -> None:
        """A person wants the robot to stop: it brakes to rest, the drive goes off, and everything is recorded."""
        self._interrupted = True

    def _episodes(self, log: FlightLog, onlooker: Onlooker) -> tuple[Tried, ...]:
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
        thinking = Thinking(self.times.clock, config.measured, 0.0 if config.contract else PLANNING_TIME)
        witness = Witness(world.begin, world.judgement, self._versions(), self._picture)

        def run(name: str, left: int, setback: Setback | None) -> Tried:
            episode, stored = run_episode(
                self._errand(name, left, setback), self.planner, self.memory, layer, thinking, witness, self._keep,
                now=self.times.now(), look_up=self._look_up, granted=self.grants,
            )  # fmt: skip
            _note_weights(log, layer.state.stamp, stored)
            return episode, stored

        return self._tried(log, lambda: layer.state.stamp, run)

    def _tried(
        self, log: FlightLog, now: Callable[[], float], run: Callable[[str, int, Setback | None], Tried]
    ) -> tuple[Tried, ...]:
        """Every try of the errand, each one after the first announced; a contract that was given is tried once."""

        def announced(name: str, left: int, setback: Setback | None) -> Tried:
            if setback:
                why = f"{setback.outcome.replace('_', ' ')}: {setback.undone}: {setback.reason}"
                log.note(now(), "planner", f"planning again: {why}", **msgspec.structs.asdict(setback))
            return run(name, left, setback)

        return tried(self.config.out.name, 1 if self.config.contract else self.config.tries, announced)

    def _errand(self, name: str, left: int, setback: Setback | None) -> Errand:
        """One try; to a contract that was given nothing is recalled, and it has one shot."""
        config, given = self.config, self.config.contract is not None
        return Errand(
            name, self.times.started, config.instruction, config.seed, 1 if given else config.shots,
            exemplars=0 if given else MAX_RECALLED, tries=left, setback=setback,
        )  # fmt: skip

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
        """Write down an episode as `episode.json`; the try before it becomes `episode-N.json`."""
        path = self.config.out / "episode.json"
        if episode.id not in self._kept:
            if self._kept:
                path.replace(self.config.out / f"episode-{len(self._kept)}.json")
            self._kept.append(episode.id)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(episode), indent=2))

    def _versions(self) -> dict[str, str]:
        return {
            "dualbrain": __version__, "kernel": kernel_hash(), "mujoco": metadata.version("mujoco"),
            "prompt": template_hash(), "beside": beside_hash(),
            "plant": self.plant.model_source, "filter": "on" if self.config.guard else "off",
        } | origin(self.planner)  # fmt: skip

    def __enter__(self) -> Self:
        """The session itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close everything."""
        self._stack.close()


def _note_weights(log: FlightLog, t: float, stored: StoreReport) -> None:
    """What an outcome taught, as events."""
    for one in stored.changes:
        why = f"{one.memory}: {one.rule}d" if one.rule == "reinforce" else f"{one.memory}: suppressed"
        log.note(t, "memory", why, episode_id=one.memory, before=one.before, after=one.after)


def _check_folder(out: Path) -> None:
    """Refuse a run folder that holds a run: nothing that was recorded is written over."""
    found = sorted(name for name in FILES if (out / name).exists())
    if found:
        raise InvalidSetup("run folder", got=found, allowed="a folder without a run", fix=f"Name another --out. {out}")
    if out.exists() and not out.is_dir():
        raise InvalidSetup("run folder", got="a file", allowed="a folder", fix=f"Name another --out. {out}")
