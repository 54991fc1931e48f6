"""One reported episode once more, from its recorded answers: the same motion, with somebody watching."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dualbrain.control.control_loop import Moment
from dualbrain.evaluation.episodes.case_runner import Clock, Flight, Means, fly
from dualbrain.evaluation.protocol.case import Catalogue, case_of
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal
from dualbrain.simulation.plant.plant import Plant


class Retold:
    """Answers shot by shot what was answered before; nobody is asked."""

    name = "as answered before"

    def __init__(self, answers: list[list[str]]) -> None:
        """`answers` are pairs (text, finish reason)."""
        self._answers = iter(answers)

    def propose(self, request: PlanRequest) -> Proposal:
        """The next answer."""
        del request
        text, finish = next(self._answers)
        return Proposal(text, finish, self.name, "nobody", {"total": 0.0})

    def close(self) -> None:
        """Nothing is held open."""


@dataclass(frozen=True, slots=True)
class Watching:
    """Who watches: `opened` gets the plant before anything moves, `moment` what happens now and then."""

    opened: Callable[[Plant], None] = lambda plant: None
    moment: Callable[[Moment], None] | None = None
    visuals: bool = False


def again(row: Row, suite: Suite, clock: Clock, watching: Watching, catalogue: Catalogue = case_of) -> Flight:
    """Fly `row` again; memory is not needed, for what it led to stands in the answers."""
    task = next(task for task in suite.tasks if task.name == row.task)
    case = catalogue(task, row.seed, row.robot, row.repetition)

    def picture(plant: Plant) -> Picture | None:
        watching.opened(plant)
        return None

    means = Means(
        "again", Retold(row.answers), clock, shots=max(1, len(row.answers)), planning_time=suite.planning_time,
        watch=watching.moment, picture=picture, visuals=watching.visuals,
    )  # fmt: skip
    return fly(case, find_method(row.method), means)


def differs(row: Row, flight: Flight) -> list[str]:
    """What came out otherwise than recorded: nothing, on the same machine and code."""
    outcome, judgement = flight.episode.outcome, flight.episode.judgement
    pairs = {
        "outcome": (row.outcome, outcome.kind), "reason": (row.reason, outcome.reason),
        "Δ": (row.Delta, outcome.Delta if row.Delta is not None else None), "h_min": (row.h_min, outcome.h_min),
        "motion": (row.motion_s, outcome.duration),
        "violations": (len(row.violations), len(judgement.violations) if judgement else 0),
    }  # fmt: skip
    return [f"{name}: {before}, now {now}" for name, (before, now) in pairs.items() if before != now]
