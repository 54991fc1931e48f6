"""Helpers of the stories: contracts as text, and sessions in a temporary folder with their results."""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from dualbrain.core.paths import cache_folder
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Episode
from dualbrain.runtime.backends import simulated
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, RunResult, Session

REGISTRY = load_skill_registry("panda").hash
INSTRUCTION = "put the red cube in the bowl"
GRASP = {
    "object": "red_cube",
    "speed": 0.25,
    "clearance": 0.1,
    "finger_axis": "along",
    "opening": 0.07,
    "approach": "top",
    "wait": "none",
    "force": 20.0,
}
PLACE = {"destination": "blue_bowl", "speed": 0.25, "clearance": 0.12, "route": "direct", "wait": "none"}


def contract_text(*actions, robot="panda", registry=REGISTRY, id="c-0001"):
    """The text of a contract from (skill, parameters) pairs."""
    sequence = [{"skill": skill, "params": params} for skill, params in actions]
    return json.dumps({"id": id, "context": {"robot": robot, "registry": registry}, "action_sequence": sequence})


def hold_contract(duration=0.5):
    """A short contract that is accepted in every scene."""
    return contract_text(("hold", {"duration": duration}))


def decline_contract(reason="there is no such object here"):
    return contract_text(("decline", {"reason": reason}))


@dataclass
class StoryResult:
    """A finished run: its result, planner and configuration, interrupted runs, and the largest joint motion [rad]."""

    result: RunResult
    planner: ScriptedPlanner
    config: RunConfig
    interrupted: tuple
    displacement: float

    @property
    def episode(self) -> Episode:
        return self.result.episode

    @property
    def stored_episode(self) -> Episode:
        """The episode as stored on disk."""
        return msgspec.json.decode(self.config.out.joinpath("episode.json").read_bytes(), type=Episode)


def run_config(folder: Path, name="run", **changes) -> RunConfig:
    start = RunConfig(
        instruction=INSTRUCTION,
        out=folder / name,
        ledger=folder / "ledger.sqlite",
        cache=cache_folder(),
        scene="bare:0",
        visuals=False,
    )
    return replace(start, **changes)


def make_clocks() -> Clocks:
    return Clocks(time.monotonic, "2026-01-01T00:00:00+00:00", time.time)


def run_session(config: RunConfig, *answers: str, finish="stop", observer=None, before=None) -> StoryResult:
    """Run a session whose planner gives `answers`; `before(session)` may prepare it."""
    planner = ScriptedPlanner(answers, finish_reason=finish)
    planning_time, simulated.PLANNING_TIME = simulated.PLANNING_TIME, 0.02
    try:
        with Session(config, make_clocks(), {}, planner) as session:
            if before:
                before(session)
            start = session.plant.read().q
            finished = session.run(observer or RunObserver())
            moved = float(abs(session.plant.read().q - start).max())
            return StoryResult(finished, planner, config, session.interrupted_runs, moved)
    finally:
        simulated.PLANNING_TIME = planning_time


def ledger_episodes(path: Path) -> list[dict]:
    """The episodes of a ledger, whose hash chain is verified."""
    with LedgerReader(path) as ledger:
        assert ledger.verify().is_intact
        return [msgspec.json.decode(event.payload) for event in ledger.events("episode")]


def ledger_kinds(path: Path) -> list[str]:
    with LedgerReader(path) as ledger:
        assert ledger.verify().is_intact
        return [event.kind for event in ledger.events()]
