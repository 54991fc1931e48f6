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
from dualbrain.adaptation.serving.open_planner import open_planner, planner_provenance
from dualbrain.contracts.registry import is_narrower
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ExecutorConfig
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from dualbrain.core import weights
from dualbrain.core.text import storable_text
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.document_retrieval import retrieve_passages
from dualbrain.grounding.map_overlay import apply_map
from dualbrain.knowledge.builtin_documents import open_library
from dualbrain.knowledge.library import Library
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_encoder import IMAGE_WEIGHTS, ImageEncoder
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.maintenance.edits import record_uses
from dualbrain.memory.memory import Memory, StoreReport
from dualbrain.memory.plasticity.rule import Plasticity
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, conditional_text_hash, template_hash
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode, FailureFeedback, Passage
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.runtime.config import Clocks, RunConfig, RunObserver, RunResult
from dualbrain.runtime.counterfactual import CounterfactualQueries
from dualbrain.runtime.episode import EpisodeRequest, GroundTruth, run_episode
from dualbrain.runtime.planning_time import PLANNING_TIME, PlanningClock
from dualbrain.runtime.replanning import TryResult, run_tries
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.safety.integration.site import site_obstacles, site_robot, site_skill_grants
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import save_scene
from dualbrain.simulation.tasks.multi_goal import parse_goals
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import skill_registry

RUN_FILES = ("config.json", "scene.json", "episode.mcap", "episode.json", "report.html")
"""What a run leaves in its folder."""
__all__ = ["RUN_FILES", "RunResult", "RunObserver", "RunConfig", "Session", "Clocks"]


class Session:
    """One robot, one scene, one planner, one memory."""

    def __init__(
        self, config: RunConfig, clocks: Clocks, environ: Mapping[str, str], planner: Planner | None = None
    ) -> None:
        """Open everything; raises `MissingPart`, `InvalidSetup` or `UnknownName` before anything has moved.

        A `planner` that is handed in serves this session and stays open; otherwise the configured one is opened.
        """
        out = config.out if config.out.name not in ("", "..") else config.out.resolve()  # a run needs a name
        self.config, self.clocks = replace(config, instruction=storable_text(config.instruction), out=out), clocks
        self._stack = ExitStack()
        self._stop_requested = False
        self._saved_ids: list[str] = []
        try:
            self._open(environ, planner)
        except BaseException:
            self._stack.close()
            raise

    def _open(self, environ: Mapping[str, str], planner: Planner | None) -> None:
        config = self.config
        _check_folder(config.out)
        site = read_site(config.site) if config.site else None
        self.robot_model = site_robot(load_robot(config.robot), site) if site else load_robot(config.robot)
        self.fixed_obstacles = site_obstacles(self.robot_model, site) if site else ()
        self.grants = site_skill_grants(site, frozenset(skill_registry(self.robot_model).by_name)) if site else None
        self.spec = open_scene(config.scene, config.robot)
        encoder = MiniLmEncoder.from_cache(config.cache)
        self.library = self._open_library(encoder)
        if self.library is not None and config.map:
            self.spec = apply_map(self.spec, self.robot_model, self.library, config.map)
        goal = parse_goals(config.goal, self.spec) if config.goal else None
        self._image_encoder = (
            ImageEncoder(weights.locate_weights(IMAGE_WEIGHTS, config.cache)) if config.image_memory else None
        )
        self.planner = planner or self._open_planner(environ)
        if planner is None:
            self._stack.callback(self.planner.close)
        config.out.mkdir(parents=True, exist_ok=True)
        config.ledger.parent.mkdir(parents=True, exist_ok=True)
        ledger = Ledger(config.ledger, holder=f"dualbrain run {config.out.name}", now=self.clocks.now())
        self._stack.callback(ledger.close)
        self.ledger = ledger
        rule = None if config.static else Plasticity(epsilon=config.epsilon)
        self.memory = Memory(
            ledger, encoder, MemoryConfig(limits=(PostureLimits.from_model(self.robot_model),), plasticity=rule)
        )
        self.plant = make_plant(self.spec, self.robot_model, visuals=config.visuals)
        perception = NoisyPerception(self.spec, PerceptionNoise(), np.random.default_rng([config.seed, 1]))
        self.world = SimulatedWorld(self.plant, perception, goal=goal, pace=self.clocks.pace)
        self.interrupted_runs: tuple[InterruptedRun, ...] = ()

    def _open_library(self, encoder: MiniLmEncoder) -> Library | None:
        """The documents, if something is to be taken from them."""
        asked = self.config.consult and self.config.contract is None
        if self.config.knowledge is None or not (asked or self.config.map):
            return None
        library = open_library(self.config.knowledge, encoder, now=self.clocks.now())
        self._stack.callback(library.close)
        return library

    def _open_planner(self, environ: Mapping[str, str]) -> Planner:
        if self.config.contract:
            return FixedContractPlanner(f"file {self.config.contract.name}", self.config.contract.read_bytes())
        prefixes = self.config.cache / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        key = environ.get("OPENAI_API_KEY", "")
        adapters = self.config.adapters or self.config.ledger.with_name("adapters")
        registry, own = skill_registry(self.robot_model), skill_registry(load_robot(self.config.robot))
        return open_planner(
            self.config.planner,
            self.config.cache,
            adapters=adapters,
            robot=self.robot_model.name,
            registry=registry.hash,
            key=key,
            prompt_cache=prefixes,
            narrowed_registries={registry.hash: own.hash} if is_narrower(registry, own) else {},
        )

    def run(self, observer: RunObserver) -> RunResult:
        """Run the instruction; the run folder holds config, scene, recording and episode when this returns."""
        config, out = self.config, self.config.out
        out.joinpath("config.json").write_bytes(
            msgspec.json.format(msgspec.json.encode(config, enc_hook=str), indent=2)
        )
        save_scene(self.spec, out / "scene.json")
        self.interrupted_runs = self.ledger.start_run(
            out.name, {"instruction": config.instruction}, now=self.clocks.now()
        )
        trace = Trace(self.robot_model.n, self.robot_model.nq)
        with Recorder(out / "episode.mcap", trace, when_full="wait") as recorder:
            log = FlightLog(trace, recorder, observer.on_event)
            about = {"robot": config.robot, "guard": config.guard, "instruction": config.instruction}
            if config.site:
                about |= {"body": self.robot_model, "standing": self.fixed_obstacles}
            recorder.episode(0.0, {**about, "versions": self._versions()})
            try:
                tries = self._run_episodes(log, observer)
            finally:
                self.plant.stop()
        return self._finish(tries, trace)

    def _finish(self, tries: tuple[TryResult, ...], trace: Trace) -> RunResult:
        """The end of a run: what its last try was, after what became of the memories in its prompt."""
        *earlier, (episode, stored) = tries
        episode = self._with_memory_uses(episode)
        self.ledger.end_run({"outcome": episode.outcome.kind}, now=self.clocks.now())
        return RunResult(episode, stored, trace, tuple(one for one, _ in earlier))

    def interrupt(self) -> None:
        """A person wants the robot to stop: it brakes to rest, the drive goes off, and everything is recorded."""
        self._stop_requested = True

    def _run_episodes(self, log: FlightLog, onlooker: RunObserver) -> tuple[TryResult, ...]:
        config, world = self.config, self.world

        def phase_changed(phase: str, roles: dict[str, str | None]) -> None:
            world.set_phase(phase, roles)
            onlooker.on_phase(phase)

        layer = ContractExecutor(
            self.robot_model,
            self.plant,
            world,
            SafetyFilter(self.robot_model, fixed_obstacles=self.fixed_obstacles),
            log,
            ExecutorConfig(guard=config.guard),
            on_tick=onlooker.on_tick,
            on_phase=phase_changed,
            interrupted=lambda: self._stop_requested,
            clock=lambda: self.plant.now,
        )
        thinking = PlanningClock(self.clocks.clock, config.measured, 0.0 if config.contract else PLANNING_TIME)
        witness = GroundTruth(world.start_contract, world.judgement, self._versions(), self._image_features)

        def run(name: str, left: int, setback: FailureFeedback | None) -> TryResult:
            episode, stored = run_episode(
                self._episode_request(name, left, setback),
                self.planner,
                self.memory,
                layer,
                thinking,
                witness,
                self._save_episode,
                now=self.clocks.now(),
                retrieve_passages=self._retrieve_passages,
                allowed_skills=self.grants,
            )
            _log_weight_changes(log, layer.state.stamp, stored)
            return episode, stored

        return self._run_tries(log, lambda: layer.state.stamp, run)

    def _run_tries(
        self, log: FlightLog, now: Callable[[], float], run: Callable[[str, int, FailureFeedback | None], TryResult]
    ) -> tuple[TryResult, ...]:
        """Every try of the errand, each one after the first announced; a contract that was given is tried once."""

        def announced(name: str, left: int, setback: FailureFeedback | None) -> TryResult:
            if setback:
                why = f"{setback.outcome.replace('_', ' ')}: {setback.undone}: {setback.reason}"
                log.note(now(), "planner", f"planning again: {why}", **msgspec.structs.asdict(setback))
            return run(name, left, setback)

        return run_tries(self.config.out.name, 1 if self.config.contract else self.config.tries, announced)

    def _episode_request(self, name: str, left: int, setback: FailureFeedback | None) -> EpisodeRequest:
        """One try; to a contract that was given nothing is recalled, and it has one shot."""
        config, given = self.config, self.config.contract is not None
        return EpisodeRequest(
            id=name,
            started=self.clocks.started,
            instruction=config.instruction,
            seed=config.seed,
            max_shots=1 if given else config.shots,
            max_exemplars=0 if given else MAX_RECALLED,
            tries_left=left,
            setback=setback,
        )

    def _with_memory_uses(self, episode: Episode) -> Episode:
        """The episode with what became of the memories in its prompt, if that is wanted; it is written down."""
        if not self.config.utility or self.config.contract is not None:
            return episode
        kept = self.config.ledger.with_name("counterfactuals")
        asking = CounterfactualQueries(self.planner, skill_registry(self.robot_model), kept)
        uses = asking.memory_uses(episode, should_stop=lambda: self._stop_requested)
        if uses:
            episode = msgspec.structs.replace(episode, uses=uses)
            self._save_episode(episode)
            record_uses(self.memory, episode.id, uses, now=self.clocks.now())
        return episode

    def _retrieve_passages(self, instruction: str, summary: str) -> tuple[Passage, ...]:
        """What the documents say to this, if they are to be asked."""
        if self.library is None or not self.config.consult:
            return ()
        return retrieve_passages(self.library, instruction, summary, skill_registry(self.robot_model))

    def _image_features(self) -> ImageFeatures | None:
        """What the camera at the front sees now, as features."""
        if self._image_encoder is None:
            return None
        with Camera(self.plant, width=320, height=240) as camera:
            return self._image_encoder.encode(camera.capture())

    def _save_episode(self, episode: Episode) -> None:
        """Write down an episode as `episode.json`; the try before it becomes `episode-N.json`."""
        path = self.config.out / "episode.json"
        if episode.id not in self._saved_ids:
            if self._saved_ids:
                path.replace(self.config.out / f"episode-{len(self._saved_ids)}.json")
            self._saved_ids.append(episode.id)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(episode), indent=2))

    def _versions(self) -> dict[str, str]:
        return {
            "dualbrain": __version__,
            "kernel": kernel_hash(),
            "mujoco": metadata.version("mujoco"),
            "prompt": template_hash(),
            "beside": conditional_text_hash(),
            "plant": self.plant.model_source,
            "filter": "on" if self.config.guard else "off",
        } | planner_provenance(self.planner)

    def __enter__(self) -> Self:
        """The session itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close everything."""
        self._stack.close()


def _log_weight_changes(log: FlightLog, t: float, stored: StoreReport) -> None:
    """What an outcome taught, as events."""
    for one in stored.weight_updates:
        why = f"{one.memory}: {one.rule}d" if one.rule == "reinforce" else f"{one.memory}: suppressed"
        log.note(t, "memory", why, episode_id=one.memory, before=one.before, after=one.after)


def _check_folder(out: Path) -> None:
    """Refuse a run folder that holds a run: nothing that was recorded is written over."""
    found = sorted(name for name in RUN_FILES if (out / name).exists())
    if found:
        raise ConfigurationError(
            "run folder", got=found, allowed="a folder without a run", fix=f"Name another --out. {out}"
        )
    if out.exists() and not out.is_dir():
        raise ConfigurationError("run folder", got="a file", allowed="a folder", fix=f"Name another --out. {out}")
