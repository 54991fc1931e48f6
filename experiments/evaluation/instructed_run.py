"""One run of an instruction with a planner, as by `dualbrain run`, and its row with the true final state."""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import registry_hashes
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.serving.open_planner import open_planner
from dualbrain.contracts.verdict import Rejected
from dualbrain.core import paths
from dualbrain.evaluation.analysis.violation_kinds import BROKEN
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, Session
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.skills.registry import skill_registry
from experiments.engine.experiment import Row
from experiments.evaluation.instructions.final_state import FinalState, MotionRecorder
from experiments.safety.closed_loop import judgement_fields, outcome_fields

REPORTED_FIELDS = "attempts contract outcome judgement timings versions binding uses failure_feedback"
KNOWN_EPISODE_FIELDS = frozenset(
    f"id started instruction robot registry seed scene summary recall {REPORTED_FIELDS}".split()
)
"""Fields of an episode that the row has elsewhere or leaves out; all others are independent senses, copied by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructedRun:
    """A finished run: all episodes (the last one counts), the scene, and the final state on ground truth."""

    episodes: tuple[Episode, ...]
    spec: SceneSpec
    state: FinalState

    @property
    def episode(self) -> Episode:
        """The last episode."""
        return self.episodes[-1]


@cache
def open_named_planner(name: str, robot: str) -> Planner | None:
    """The planner with a name or URL, or a contract file; None if it is an adapter for other robots."""
    if name.endswith(".json"):
        return FixedContractPlanner(name, Path(name).read_bytes())
    prefixes = paths.cache_folder() / "prefixes"
    prefixes.mkdir(parents=True, exist_ok=True)
    if name in packaged_names() and robot not in registry_hashes(read_adapter_card(packaged_folder(name))):
        return None
    return open_planner(
        name,
        paths.cache_folder(),
        adapters=paths.dualbrain_home() / "adapters",
        robot=robot,
        registry=skill_registry(load_robot(robot)).hash,
        key=os.environ.get("OPENAI_API_KEY", ""),
        prompt_cache=prefixes,
    )


def planners_of(name: str) -> tuple[str, ...]:
    """The planners that `--planner` names: "packaged" for every packaged one, else the one of that name."""
    return packaged_names() if name == "packaged" else (name,)


def run_instruction(
    instruction: str, robot: str, scene: str, planner: Planner, *, goal: str = "", tries: int = 2, seed: int = 0
) -> InstructedRun:
    """Run one instruction with an empty memory in lockstep with the simulation; its files are deleted."""
    with tempfile.TemporaryDirectory(prefix="dualbrain-experiment-") as folder:
        config = RunConfig(
            instruction=instruction,
            out=Path(folder) / "run",
            ledger=Path(folder) / "ledger.sqlite",
            cache=paths.cache_folder(),
            robot=robot,
            scene=scene,
            tries=tries,
            seed=seed,
            goal=goal,
            visuals=False,
        )
        clocks = Clocks(time.monotonic, datetime.now(UTC).isoformat(timespec="seconds"), time.time)
        with Session(config, clocks, os.environ, planner) as session:
            recorder = MotionRecorder(session.plant)
            result = session.run(RunObserver(on_tick=lambda snapshot: recorder.update()))
            violations = session.world.judgement().violations
            broken = {name for one in violations if one.kind == BROKEN for name in one.bodies}
            fragile = {obj.name for obj in session.spec.objects if obj.fragile_limit is not None}
            state = msgspec.structs.replace(recorder.final_state(), broken=tuple(sorted(broken & fragile)))
            return InstructedRun(episodes=(*result.earlier_episodes, result.episode), spec=session.spec, state=state)


def instructed_row(run: InstructedRun) -> Row:
    """The row of a run: outcome, judgement of its goal, every reason given, senses, and the final state."""
    episode = run.episode
    return {
        "contract": episode.contract,
        "contracts": [one.contract for one in run.episodes],
        "text": all_reasons(run.episodes),
        "attempts": sum(len(one.attempts) for one in run.episodes),
        **outcome_fields(episode.outcome),
        **judgement_fields(episode.judgement),
        **senses_of(episode),
        "state": msgspec.to_builtins(run.state),
    }


def senses_of(episode: Episode) -> dict[str, Any]:
    """The fields of an episode that state what independent senses found, by name."""
    names = [name for name in episode.__struct_fields__ if name not in KNOWN_EPISODE_FIELDS]
    return {name: msgspec.to_builtins(getattr(episode, name)) for name in names}


def all_reasons(episodes: tuple[Episode, ...]) -> str:
    """Every sentence that the robot gave: the reasons of the outcomes and the hints of the refusals."""
    sentences = [one.outcome.reason for one in episodes]
    for one in episodes:
        verdicts = [attempt.verdict for attempt in one.attempts]
        sentences += [verdict.hint for verdict in verdicts if isinstance(verdict, Rejected)]
    return " / ".join(dict.fromkeys(sentence for sentence in sentences if sentence))
