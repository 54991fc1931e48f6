"""A session: everything that one run needs, opened before any motion and closed in every case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from importlib import metadata
from types import TracebackType
from typing import Self

import msgspec

from dualbrain import __version__
from dualbrain.adaptation.serving.open_planner import planner_provenance
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.text import storable_text
from dualbrain.grounding.instruction.stop_commands import asks_to_stop
from dualbrain.memory.ledger.anchors import RUN_ANCHOR_FILE
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.ledger.runs import InterruptedRun
from dualbrain.memory.maintenance.edits import record_uses
from dualbrain.memory.memory import Memory, StoreReport
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, conditional_text_hash
from dualbrain.planner.protocol import Planner
from dualbrain.records import Episode, FailureFeedback
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.agent import Agent
from dualbrain.runtime.backends.backend import Backend, RunContext, RunningRobot
from dualbrain.runtime.backends.simulated import SimulatedBackend
from dualbrain.runtime.config import Clocks, RunConfig, RunObserver, RunResult
from dualbrain.runtime.episode import log_weight_changes, run_episode
from dualbrain.runtime.inspection.counterfactual import CounterfactualQueries
from dualbrain.runtime.planning.busy_machine import ContractEnding
from dualbrain.runtime.planning.episode_request import EpisodeRequest
from dualbrain.runtime.planning.replanning import Try, successive_tries
from dualbrain.runtime.run_folder import END_STATE_FILE, SavingMemory
from dualbrain.runtime.run_resources import open_resources
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.simulation.plant.end_state import save_end_state
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import skill_registry

TryResult = tuple[Episode, StoreReport]
__all__ = ["Clocks", "RunConfig", "RunObserver", "RunResult", "Session"]


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
        self._stop_requested, self._ending = False, ContractEnding()
        self.interrupted_runs: tuple[InterruptedRun, ...] = ()
        with ExitStack() as stack:
            self._resources = open_resources(self.config, clocks, environ, planner, stack)
            self._stack = stack.pop_all()

    @property
    def robot_model(self) -> RobotModel:
        """The robot, with the limits of its site."""
        return self._resources.site.robot_model

    @property
    def spec(self) -> SceneSpec:
        """The scene."""
        return self._resources.spec

    @property
    def planner(self) -> Planner:
        """The planner that is asked."""
        return self._resources.planner

    @property
    def memory(self) -> Memory:
        """The configured memory."""
        return self._resources.memory

    @property
    def ledger(self) -> Ledger:
        """The ledger of the configured memory."""
        return self._resources.ledger

    @property
    def world(self) -> SimulatedWorld:
        """The simulated world of this process."""
        return self._resources.world

    @property
    def plant(self) -> Plant:
        """The simulated robot with its surroundings."""
        return self.world.plant

    def run(self, observer: RunObserver) -> RunResult:
        """Run the instruction; afterwards the run folder holds configuration, scene, recording and episodes."""
        config, folder = self.config, self._resources.folder
        with folder.lent_space():
            folder.save_start(config, self.spec)
            about = {"instruction": config.instruction}
            self.interrupted_runs = self.ledger.start_run(config.out.name, about, now=self.clocks.now())
            self.ledger.anchor(config.out / RUN_ANCHOR_FILE)
        context = self._context()
        folder.release_recording_space()
        with self.backend.start(context, self._observe_endings(observer)) as robot:
            results = self._run_tries(robot)
            held = robot.executor.held_object or ""
        if end := self.backend.end_state(context, held):
            with folder.lent_space():
                save_end_state(end, config.out / END_STATE_FILE)
        return self._finish(results, self.backend.trace(context))

    def interrupt(self) -> None:
        """Make the robot stop for a person: it brakes to rest, the drive goes off, and everything is recorded."""
        self._stop_requested = True

    def instruct(self, words: str) -> bool:
        """Give an instruction during the run, from any thread; returns whether it asks to stop.

        A request to stop interrupts the run, within one control period and without a planner. Other words change
        nothing.
        """
        if asks_to_stop(words):
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
            fixed_obstacles=self._resources.site.fixed_obstacles,
            persons=self._resources.site.persons,
            object_limits=self._resources.site.object_limits,
            start=self._resources.start,
            versions=self._versions(),
            image_features=self._resources.image_features,
            camera_image=self._resources.camera_image,
            interrupted=lambda: self._stop_requested,
        )

    def _observe_endings(self, observer: RunObserver) -> RunObserver:
        """`observer`, with its events passed on to `_ending` as well."""

        def on_event(event: Event) -> None:
            self._ending.on_event(event)
            observer.on_event(event)

        return replace(observer, on_event=on_event)

    def _machine_was_busy(self) -> bool:
        return self.config.retry_when_busy and self._ending.busy_machine() is not None

    def _run_tries(self, robot: RunningRobot) -> list[TryResult]:
        """Run every try of the instruction; a given contract is tried once."""
        resources = self._resources
        given = self._agent or Agent(
            self.planner, self.memory, resources.retrieve_passages, resources.clause_classifier
        )
        agent = replace(given, memory=SavingMemory(given.memory, self._resources.folder))
        log, executor = robot.executor.log, robot.executor
        results: list[TryResult] = []
        episodes: list[Episode] = []
        tries = 1 if self.config.contract else self.config.tries
        name, held, first_held = self.config.out.name, lambda: executor.held_object, executor.held_object or ""
        for one in successive_tries(name, tries, episodes, held, self._machine_was_busy):
            if feedback := one.failure_feedback:
                details = msgspec.to_builtins(feedback)
                log.note(executor.state.stamp, "planner", self._describe_retry(feedback, one.tries_left), **details)
            self._ending.begin_try()
            request = self._episode_request(one, episodes, first_held)
            result = run_episode(request, agent, executor, robot.clock, robot.ground_truth)
            log_weight_changes(log, executor.state.stamp, result[1])
            results.append(result)
            episodes.append(result[0])
        return results

    def _describe_retry(self, feedback: FailureFeedback, tries_left: int) -> str:
        """Why the instruction is planned again, in one line."""
        check = self._ending.busy_machine()
        if self.config.retry_when_busy and check is not None:
            number = f"try {self.config.tries - tries_left + 1} of {self.config.tries}"
            return f"planning again ({number}), because this machine may have been too busy: {check.description}"
        return f"planning again: {feedback.outcome.replace('_', ' ')}: {feedback.failed_action}: {feedback.reason}"

    def _episode_request(self, one: Try, earlier: Sequence[Episode], first_held: str) -> EpisodeRequest:
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
            reuse_contracts=config.reuse_contracts,
            tries_left=one.tries_left,
            failure_feedback=one.failure_feedback,
            continuation=one.continuation,
            grants=self._resources.site.grants,
            first_scene=earlier[0].scene if earlier else None,
            first_held=first_held,
            earlier_grips=tuple(grip for episode in earlier for grip in episode.outcome.grips),
            machine_was_busy=self._machine_was_busy,
            instruction_check="given_contract" if given else "all",
        )

    def _finish(self, results: list[TryResult], trace: Trace) -> RunResult:
        """The result of the run: its last try, with the use of the memories in its prompt if that was requested."""
        self._resources.folder.release()  # for the rest of the ledger, the report and the images
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
            self._resources.folder.save_episode(episode)
            record_uses(self.ledger, episode.id, uses, now=self.clocks.now())
        return episode

    def _versions(self) -> dict[str, str]:
        return {
            "dualbrain": __version__,
            "kernel": kernel_hash(),
            "mujoco": metadata.version("mujoco"),
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
