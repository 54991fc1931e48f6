"""The run folders of an agent's robot: each episode in a folder of its own, with its report."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.storage.atomic_files import FileWriteError, write_atomically, write_remedy
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.errors import DualbrainError
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.memory import StoreReport
from dualbrain.records import Episode
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.agent import EpisodicMemory

EPISODE_FILE, REPORT_FILE = "episode.json", "report.html"
logger = logging.getLogger(__name__)


class SavedRuns:
    """The folder `runs` with one run folder per episode of `robot_model`.

    `problem` is why the newest episode is not saved, "" if it is.
    """

    def __init__(self, runs: Path, robot_model: RobotModel) -> None:
        """Save in `runs`, which is created with the first episode."""
        self._runs, self._robot_model, self.problem = runs, robot_model, ""

    def save_episode(self, episode: Episode) -> None:
        """Save the episode as `runs`/ID/episode.json.

        The robot has moved already when its episode is saved, so a failure changes no outcome: it is logged, and is the
        `problem`.
        """
        folder, self.problem = self._runs / episode.id, ""
        try:
            create_private_folder(folder)
            write_atomically(folder / EPISODE_FILE, msgspec.json.format(msgspec.json.encode(episode), indent=2))
        except (OSError, FileWriteError) as error:
            self.problem = f"The run {episode.id} is not saved: {error}"
            logger.warning("%s", self.problem)

    def save_report(self, episode: Episode, events: Sequence[Event]) -> str:
        """Save the report as `runs`/ID/report.html, with the `events` of the run; returns why it failed, or "".

        The robot has moved already when its report is written, so a failure changes no outcome: it is logged.
        """
        from dualbrain.visualization.html.run_report import write_report  # noqa: PLC0415  (heavy)

        path, trace = self._runs / episode.id / REPORT_FILE, Trace(self._robot_model.n)
        trace.events.extend(events)
        try:
            write_report(path, episode, trace)
        except Exception as error:  # also a mistake in the report
            known = isinstance(error, DualbrainError)
            problem = f"No report of the run {episode.id}: {error if known else f'{type(error).__name__}: {error}'}"
            logger.warning("%s", problem, exc_info=None if known else error)
            return problem
        return ""


class SavingMemory:
    """A memory whose episodes are saved before they are stored: an error of the ledger loses none."""

    def __init__(self, memory: EpisodicMemory, runs: SavedRuns) -> None:
        """Store in `memory`, and save in `runs`."""
        self._memory, self._runs = memory, runs
        self.retrieve = memory.retrieve
        self.find_precedents, self.find_outcomes = memory.find_precedents, memory.find_outcomes

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Save the episode, then store it; see `EpisodicMemory.store`."""
        self._runs.save_episode(episode)
        return self._memory.store(episode, state, now=now, image=image)


class ReportingMemory:
    """The memory of one episode, in which a failure to store the episode is a `problem` ("" without one) and no error.

    The robot has moved already when its episode is stored, so a failure changes no outcome.
    """

    def __init__(self, memory: EpisodicMemory) -> None:
        """Store in `memory`."""
        self._memory, self.problem = memory, ""
        self.retrieve = memory.retrieve
        self.find_precedents, self.find_outcomes = memory.find_precedents, memory.find_outcomes

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Store the episode; see `EpisodicMemory.store`. No weight changes after a failure."""
        try:
            return self._memory.store(episode, state, now=now, image=image)
        except Exception as error:  # also a mistake in the memory
            known = isinstance(error, DualbrainError)
            reason = str(error) if known else f"{type(error).__name__}: {error}. {write_remedy(error)}"
            self.problem = f"The episode {episode.id} is not stored in the memory: {reason}"
            logger.warning("%s", self.problem, exc_info=None if known else error)
            return StoreReport(episode_id=episode.id, seq=0, head=Head(0, ""), weight_updates=())
