"""A session: everything that one run needs, opened before any motion and closed in every case."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

from dualbrain import __version__
from dualbrain.adaptation.serving.open_planner import open_planner, planner_provenance
from dualbrain.contracts.gate.strict_json import MAX_CONTRACT_FILE_BYTES
from dualbrain.contracts.registry import is_narrower
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recording_file import RECORDING_RESERVE
from dualbrain.control.recording.trace import Trace
from dualbrain.core import weights
from dualbrain.core.storage.atomic_files import translated_write_errors, write_atomically
from dualbrain.core.storage.private_files import create_private_folder, open_private_folder
from dualbrain.core.storage.reserved_space import ReservedSpace
from dualbrain.core.text import storable_text
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.document_retrieval import retrieve_passages
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.grounding.map_overlay import apply_map
from dualbrain.grounding.outcome.instruction_truth import make_instruction_judge
from dualbrain.knowledge.builtin_documents import open_library
from dualbrain.knowledge.library import Library
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_encoder import IMAGE_WEIGHTS, ImageEncoder
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture, PostureLimits
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.anchors import RUN_ANCHOR_FILE
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.maintenance.edits import record_uses
from dualbrain.memory.memory import Memory, StoreReport
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, conditional_text_hash, template_hash
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode, Passage, Scene
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.runtime.agent import Agent, EpisodicMemory
from dualbrain.runtime.backends.backend import Backend, RunContext, RunningRobot
from dualbrain.runtime.backends.simulated import SimulatedBackend
from dualbrain.runtime.config import Clocks, RunConfig, RunObserver, RunResult
from dualbrain.runtime.episode import EpisodeRequest, run_episode
from dualbrain.runtime.inspection.counterfactual import CounterfactualQueries
from dualbrain.runtime.replanning import Try, successive_tries
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.safety.integration.site import site_obstacles, site_persons, site_robot, site_skill_grants
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import save_scene
from dualbrain.simulation.tasks.multi_goal import parse_goals
from dualbrain.simulation.world import make_world
from dualbrain.skills.registry import skill_registry

TryResult = tuple[Episode, StoreReport]
RESERVED_BYTES = 8_000_000
"""Space [bytes] that is reserved in the run folder, beside that for the recording, and beside the memory ledger."""
RECORDING = 2
"""Index of the space for the recording among the reserved ones."""
RUN_FILES = ("config.json", "scene.json", "episode.mcap", "episode.json", "report.html", RUN_ANCHOR_FILE)
"""Files of a run folder."""
__all__ = ["RUN_FILES", "Clocks", "RunConfig", "RunObserver", "RunResult", "Session"]


class Session:
    """One instruction on one robot, in one scene, with one planner and one memory."""

    def __init__(
        self,
        config: RunConfig,
        clocks: Clocks,
        environ: Mapping[str, str],
        planner: Planner | None = None,
        backend: Backend | None = None,
        *,
        agent: Agent | None = None,
    ) -> None:
        """Open everything that a run needs, before any motion.

        A `planner` that is passed in stays open; otherwise the configured planner is opened and closed. `backend` moves
        the robot, by default the simulator of this process. An `agent` is used instead of the configured memory and
        documents; its planner must be `planner`, and uses of its memory are not measured (`RunConfig.utility`).
        Raises `MissingDependencyError`, `ConfigurationError` and `UnknownNameError`.
        """
        self.backend = backend or SimulatedBackend()
        out = config.out if config.out.name not in ("", "..") else config.out.resolve()  # a run needs a name
        self.config, self.clocks = replace(config, instruction=storable_text(config.instruction), out=out), clocks
        self._agent = agent
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
        self.persons = site_persons(site) if site else None
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
        self._open_space()
        ledger = Ledger(
            config.ledger,
            holder=f"dualbrain run {config.out.name}",
            now=self.clocks.now(),
            run_folders=(config.out.parent,),
        )
        self._stack.callback(ledger.close)
        self.ledger = ledger
        rule = None if config.static else Plasticity(epsilon=config.epsilon)
        self.memory = Memory(
            ledger, encoder, MemoryConfig(limits=(PostureLimits.from_model(self.robot_model),), plasticity=rule)
        )
        self.world = make_world(
            self.spec,
            self.robot_model,
            seed=config.seed,
            goal=goal,
            visuals=config.visuals,
            pace=self.clocks.pace,
            instruction_judge=make_instruction_judge(config.instruction),
        )
        self.plant = self.world.plant
        self.interrupted_runs: tuple[InterruptedRun, ...] = ()

    def _open_space(self) -> None:
        """Make the folders and reserve the space that the end of the run needs, so that a full disk loses no episode.

        A run that may move unrecorded needs no reserved space.
        """
        out, ledger = self.config.out, self.config.ledger.parent
        for folder, create in ((out, _open_folder), (ledger, create_private_folder)):
            with translated_write_errors(folder):
                create(folder)
        self._reserves: list[ReservedSpace] = []
        try:
            for folder, size, purpose in (
                (out, RESERVED_BYTES, "the files at the end of the run"),
                (ledger, RESERVED_BYTES, "the memory ledger"),
                (out, RECORDING_RESERVE, "the end of the recording"),
            ):
                self._reserves.append(ReservedSpace(folder, size, purpose))
                self._stack.callback(self._reserves[-1].release)
        except ConfigurationError:
            if not self.config.unrecorded:
                with suppress(OSError):  # not empty: it is not the folder that was made above
                    out.rmdir()
                raise

    @contextmanager
    def _reserved_space(self) -> Generator[None]:
        """Free the reserved space for the writes of the body."""
        with ExitStack() as stack:
            for reserve in self._reserves:
                stack.enter_context(reserve.lent())
            yield

    def _open_library(self, encoder: MiniLmEncoder) -> Library | None:
        """The documents, if passages or a map are requested."""
        requested = self.config.consult and self.config.contract is None
        if self.config.knowledge is None or not (requested or self.config.map):
            return None
        library = open_library(self.config.knowledge, encoder, now=self.clocks.now())
        self._stack.callback(library.close)
        return library

    def _open_planner(self, environ: Mapping[str, str]) -> Planner:
        if self.config.contract:
            return FixedContractPlanner(
                f"file {self.config.contract.name}", read_bounded_file(self.config.contract, MAX_CONTRACT_FILE_BYTES)
            )
        if is_stop_command(self.config.instruction):
            return FixedContractPlanner("no planner: a stop command", b"")
        prefixes = self.config.cache / "prefixes"
        open_private_folder(prefixes)
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
        """Run the instruction; afterwards the run folder holds configuration, scene, recording and episodes."""
        config, out = self.config, self.config.out
        with self._reserved_space():
            write_atomically(out / "config.json", config.encode())
            save_scene(self.spec, out / "scene.json")
            about = {"instruction": config.instruction}
            self.interrupted_runs = self.ledger.start_run(out.name, about, now=self.clocks.now())
            self.ledger.anchor(out / RUN_ANCHOR_FILE)
        context = self._context()
        for reserve in self._reserves[RECORDING:]:  # the recorder reserves its own space
            reserve.release()
        with self.backend.start(context, observer) as robot:
            results = self._run_tries(robot)
        return self._finish(results, self.backend.trace(context))

    def interrupt(self) -> None:
        """Make the robot stop for a person: it brakes to rest, the drive goes off, and everything is recorded."""
        self._stop_requested = True

    def instruct(self, words: str) -> bool:
        """Give an instruction during the run, from any thread; returns whether it was a stop command.

        A stop command interrupts the run, within one control period and without a planner. Other words change nothing.
        """
        if is_stop_command(words):
            self.interrupt()
            return True
        return False

    def _context(self) -> RunContext:
        return RunContext(
            config=self.config,
            clocks=self.clocks,
            robot_model=self.robot_model,
            spec=self.spec,
            world=self.world,
            fixed_obstacles=self.fixed_obstacles,
            persons=self.persons,
            versions=self._versions(),
            image_features=self._image_features,
            interrupted=lambda: self._stop_requested,
        )

    def _run_tries(self, robot: RunningRobot) -> list[TryResult]:
        """Run every try of the instruction; a given contract is tried once."""
        given = self._agent or Agent(self.planner, self.memory, self._retrieve_passages)
        agent = replace(given, memory=_SavingMemory(given.memory, self._save_episode, self._reserved_space))
        log, executor = robot.executor.log, robot.executor
        results: list[TryResult] = []
        episodes: list[Episode] = []
        tries = 1 if self.config.contract else self.config.tries
        for one in successive_tries(self.config.out.name, tries, episodes, lambda: executor.held_object):
            if feedback := one.failure_feedback:
                reason = f"{feedback.outcome.replace('_', ' ')}: {feedback.failed_action}: {feedback.reason}"
                details = msgspec.to_builtins(feedback)
                log.note(executor.state.stamp, "planner", f"planning again: {reason}", **details)
            request = self._episode_request(one, episodes[0].scene if episodes else None)
            result = run_episode(request, agent, executor, robot.clock, robot.ground_truth)
            _log_weight_changes(log, executor.state.stamp, result[1])
            results.append(result)
            episodes.append(result[0])
        return results

    def _episode_request(self, one: Try, first_scene: Scene | None) -> EpisodeRequest:
        """The request of one try; a given contract has one shot, and nothing is retrieved for it."""
        config, given = self.config, self.config.contract is not None
        return EpisodeRequest(
            id=one.name,
            started=self.clocks.started,
            instruction=config.instruction,
            seed=config.seed,
            now=self.clocks.now(),
            max_shots=1 if given else config.shots,
            max_exemplars=0 if given else MAX_RECALLED,
            tries_left=one.tries_left,
            failure_feedback=one.failure_feedback,
            continuation=one.continuation,
            grants=self.grants,
            first_scene=first_scene,
            instruction_check="given_contract" if given else "all",
        )

    def _finish(self, results: list[TryResult], trace: Trace) -> RunResult:
        """The result of the run: its last try, with the use of the memories in its prompt if that was requested."""
        for reserve in self._reserves:  # for the rest of the ledger, the report and the images
            reserve.release()
        *earlier, (episode, stored) = results
        episode = self._with_memory_uses(episode)
        self.ledger.end_run({"outcome": episode.outcome.kind}, now=self.clocks.now())
        self.ledger.anchor(self.config.out / RUN_ANCHOR_FILE)
        return RunResult(episode, stored, trace, tuple(one for one, _ in earlier))

    def _with_memory_uses(self, episode: Episode) -> Episode:
        """The episode with the use of each memory in its prompt, if that was requested; the episode is saved again."""
        if not self.config.utility or self.config.contract is not None or self._agent is not None:
            return episode
        folder = self.config.ledger.with_name("counterfactuals")
        queries = CounterfactualQueries(self.planner, skill_registry(self.robot_model), folder)
        uses = queries.memory_uses(episode, should_stop=lambda: self._stop_requested)
        if uses:
            episode = msgspec.structs.replace(episode, uses=uses)
            self._save_episode(episode)
            record_uses(self.memory, episode.id, uses, now=self.clocks.now())
        return episode

    def _retrieve_passages(self, instruction: str, summary: str) -> tuple[Passage, ...]:
        """Passages of the documents that bear on the instruction, if the configuration requests them."""
        if self.library is None or not self.config.consult:
            return ()
        return retrieve_passages(self.library, instruction, summary, skill_registry(self.robot_model))

    def _image_features(self) -> ImageFeatures | None:
        """Features of the front camera's current image."""
        if self._image_encoder is None:
            return None
        with Camera(self.plant, width=320, height=240) as camera:
            return self._image_encoder.encode(camera.capture())

    def _save_episode(self, episode: Episode) -> None:
        """Save an episode as `episode.json`; the file of the try before is renamed to `episode-N.json`."""
        path = self.config.out / "episode.json"
        if episode.id not in self._saved_ids:
            if self._saved_ids:
                path.replace(self.config.out / f"episode-{len(self._saved_ids)}.json")
            self._saved_ids.append(episode.id)
        write_atomically(path, msgspec.json.format(msgspec.json.encode(episode), indent=2))

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


class _SavingMemory:
    """A memory whose episodes are saved before they are stored, so that an error of the ledger loses no episode.

    Both happen in the context `space`, in which the reserved space is free.
    """

    def __init__(
        self,
        memory: EpisodicMemory,
        save: Callable[[Episode], None],
        space: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._memory, self._save, self._space = memory, save, space
        self.retrieve = memory.retrieve

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        with self._space():
            self._save(episode)
            return self._memory.store(episode, state, now=now, image=image)


def _log_weight_changes(log: FlightLog, t: float, stored: StoreReport) -> None:
    """Log the weight changes that an outcome caused."""
    for one in stored.weight_updates:
        text = f"{one.memory}: {one.rule}d" if one.rule == "reinforce" else f"{one.memory}: suppressed"
        log.note(t, "memory", text, episode_id=one.memory, before=one.before, after=one.after)


def _open_folder(out: Path) -> None:
    """Create the run folder with mode 0700; a folder with other files keeps its permissions."""
    if out.is_dir() and any(out.iterdir()):
        return
    open_private_folder(out)


def _check_folder(out: Path) -> None:
    """Refuse a run folder that already holds a run, so that no recording is overwritten."""
    found = sorted(name for name in RUN_FILES if (out / name).exists())
    if found:
        names = ", ".join(found)
        raise ConfigurationError.stating(
            f"The run folder {out} already holds a run ({names}).", fix="Name another --out."
        )
    if out.exists() and not out.is_dir():
        raise ConfigurationError.stating(f"The run folder {out} is a file.", fix="Name another --out.")
