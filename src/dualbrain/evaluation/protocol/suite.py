"""A suite as data: which tasks, methods and planners, how many episodes, with which seeds."""

from __future__ import annotations

import re
from collections import Counter
from importlib import resources
from itertools import product
from math import inf
from pathlib import Path
from typing import Literal

import msgspec

from dualbrain.errors import DECODE_ERRORS, ConfigurationError, UnknownNameError
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.simulation.tasks.families import Level, RequestType, supports_depth_perception, task_families_for

PILOT_SEEDS = range(10_000, 20_000)
"""ε is set on these, before any test."""
START_SEEDS = range(20_000, 30_000)
"""The ledger from which all arms with memory start."""
TEST_SEEDS = range(40_000, 50_000)
"""What is reported."""
TOML_SUFFIX = ".toml"
FROM_PILOT = "pilot"
NAME_PATTERN = r"\w[\w .-]*"
"""How a suite may be called."""


class Task(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One family at one level, and what is asked there (its errand, or what should be declined).

    `wordings`: all ways to ask, or those that no training saw. `robots` empty: those of the suite.
    """

    family: str
    level: Level = "I"
    ask: RequestType = "errand"
    wordings: Literal["all", "held_out"] = "all"
    robots: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Family and level, and what else than the errand is asked."""
        return self.base_name + (f" {self.ask}" if self.ask != "errand" else "")

    @property
    def base_name(self) -> str:
        """The name of the task that its pilot and its common ledger are of: there something can be done."""
        return f"{self.family} {self.level}"


class MemorySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How methods with memory begin. `start`: random valid contracts, flown into the ledger that all start from.

    `epsilon` is ε, or `"pilot"`: the median Δ of the successes that the filter corrected, among `pilot` episodes of B3
    by the base planner, frozen before any test. `utility`: every so many-th repetition the planner is asked again
    without each exemplar; 0: never.
    """

    start: int = 0
    epsilon: float | str = 0.003
    pilot: int = 0
    utility: int = 0


class Suite(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"description": "says"}, kw_only=True):
    """Everything that decides what is done; the resolved suite stands beside its results.

    Every method flies `seeds` scenes of each task, each `repetitions` times. The scenes are dealt to `runs` runs; a
    method with memory flies a run in its order with a fresh ledger, and runs are the unit of statistics of all methods.
    `planners` names a planner for each part that methods ask for (`base`, `prompted`, `adapted`, …). `bare`: every so
    many-th repetition the contract is flown once more, unfiltered in the bare scene, for the seconds lost; 0: never.
    `gallery`: failures with pictures. `free`: every so many-th repetition the first question is also answered with
    nothing that binds the answer, for compliance; 0: never.
    """

    name: str
    description: str
    methods: tuple[str, ...]
    tasks: tuple[Task, ...]
    planners: dict[str, str]
    robots: tuple[str, ...] = ("panda",)
    seeds: int = 1
    repetitions: int = 1
    runs: int = 1
    first: int = TEST_SEEDS.start
    shots: int = 1
    planning_time: float = 2.0
    bare: int = 0
    gallery: int = 6
    free: int = 0
    memory: MemorySettings = MemorySettings()

    @property
    def resolved_methods(self) -> tuple[Method, ...]:
        """The methods; raises `UnknownName`."""
        return tuple(find_method(name) for name in self.methods)

    @property
    def episodes_per_task(self) -> int:
        """Episodes of one method in one task on one robot."""
        return self.seeds * self.repetitions

    @property
    def base_tasks(self) -> tuple[Task, ...]:
        """What its tasks come from: each family and level once, for the robots of all that ask something of it."""
        found: dict[tuple[str, Level], dict[str, None]] = {}
        for task in self.tasks:
            found.setdefault((task.family, task.level), {}).update(dict.fromkeys(self.robots_of(task)))
        return tuple(
            Task(family=family, level=level, robots=tuple(robots)) for (family, level), robots in found.items()
        )

    def robots_of(self, task: Task) -> tuple[str, ...]:
        """The robots that fly `task`: those of the suite that can have it, unless it names its own."""
        return task.robots or tuple(robot for robot in self.robots if task.family in task_families_for(robot))

    def includes(self, method: str, task: Task) -> bool:
        """Whether `method` flies `task`: every one does, unless the task names its own."""
        return not task.methods or method in task.methods

    def n_clusters(self, method: str) -> int:
        """Units of statistics of `method`: runs, and of what is to be declined sentences, at most one an episode."""
        return sum(
            len(self.robots_of(task)) * (self.runs if task.ask == "errand" else self.episodes_per_task)
            for task in self.tasks
            if self.includes(method, task)
        )


def is_due(every: int, repetition: int) -> bool:
    """Whether what is done every so many-th repetition, or never (0), is done in this one: the same for all methods."""
    return every > 0 and repetition % every == 0


def builtin_suites() -> tuple[str, ...]:
    """Names of the suites that come with the package."""
    folder = resources.files("dualbrain.evaluation").joinpath("suites")
    return tuple(
        sorted(file.name.removesuffix(TOML_SUFFIX) for file in folder.iterdir() if file.name.endswith(TOML_SUFFIX))
    )


def load_suite(name: str) -> Suite:
    """The suite called `name`, or the one in a TOML file; raises `UnknownName`, or `InvalidSetup` with the field."""
    if not name.endswith(TOML_SUFFIX):
        if name not in builtin_suites():
            raise UnknownNameError("suite", name, builtin_suites(), owner="dualbrain (a TOML file also works)")
        data = resources.files("dualbrain.evaluation").joinpath("suites", name + TOML_SUFFIX).read_bytes()
    else:
        try:
            data = Path(name).read_bytes()
        except OSError as error:
            raise ConfigurationError(
                "suite file", got=error.strerror, allowed="a readable TOML file", fix=name
            ) from error
    return parse_suite(data, name)


def parse_suite(data: bytes, name: str) -> Suite:
    """The suite in `data`, checked."""
    try:
        suite = msgspec.toml.decode(data, type=Suite)
    except DECODE_ERRORS as error:
        raise ConfigurationError(
            "suite", got=str(error), allowed="a suite as in docs/evaluation.md", fix=name
        ) from error
    check_suite(suite)
    return suite


def check_suite(suite: Suite) -> None:
    """Refuse a suite that cannot be flown as it is meant; raises `InvalidSetup` and `UnknownName`."""
    _ = suite.resolved_methods
    for check in (_check_name, _check_unique, _check_tasks, _check_perception, _check_numbers, _check_memory):
        check(suite)


def _check_name(suite: Suite) -> None:
    """The name becomes that of a folder."""
    if not re.fullmatch(NAME_PATTERN, suite.name):
        allowed = "letters, digits, spaces and . _ -, beginning with a letter or digit"
        raise ConfigurationError("name of the suite", got=suite.name, allowed=allowed)


def _check_unique(suite: Suite) -> None:
    """What is named twice would be flown once and counted twice."""
    named = {"methods": suite.methods, "robots": suite.robots, "tasks": tuple(task.name for task in suite.tasks)}
    for task in suite.tasks:
        named |= {f"methods of {task.name}": task.methods, f"robots of {task.name}": task.robots}
    for what, names in named.items():
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise ConfigurationError(
                f"{what} of suite {suite.name}", got=f"{', '.join(twice)} twice", allowed="each once"
            )


def _check_tasks(suite: Suite) -> None:
    if not suite.tasks or not suite.methods or not suite.robots:
        raise ConfigurationError(f"suite {suite.name}", got="nothing to do", allowed="tasks, methods and robots")
    for task in suite.tasks:
        for method in task.methods:
            find_method(method)
        for robot in suite.robots_of(task):
            if task.family not in task_families_for(robot):
                raise UnknownNameError("family", task.family, task_families_for(robot), owner=robot)
        if not suite.robots_of(task):
            got = f"{task.name} for {', '.join(suite.robots)}"
            raise ConfigurationError(
                f"tasks of suite {suite.name}", got=got, allowed="tasks that one of its robots can have"
            )


def _check_perception(suite: Suite) -> None:
    """Depth cameras tell no person and no room: such a task is not for a method that has nothing else to see with."""
    for arm, task in product([arm for arm in suite.resolved_methods if arm.perception == "depth"], suite.tasks):
        hidden = [
            robot for robot in suite.robots_of(task) if not supports_depth_perception(task.family, task.level, robot)
        ]
        if suite.includes(arm.name, task) and hidden:
            fix = f"Leave out {arm.name}, or name the task's methods without it."
            raise ConfigurationError(f"task of {arm.name}", got=task.name, allowed="a table without people", fix=fix)


def _check_numbers(suite: Suite) -> None:
    if min(suite.seeds, suite.repetitions, suite.runs, suite.shots) < 1 or suite.runs > suite.seeds:
        got = (suite.seeds, suite.repetitions, suite.runs)
        raise ConfigurationError(
            "seeds, repetitions, runs", got=got, allowed="at least 1 each, and no more runs than seeds"
        )
    if not 0.0 <= suite.planning_time < inf:
        raise ConfigurationError(
            "planning_time", got=suite.planning_time, allowed="seconds of the simulation, at least 0"
        )
    if suite.gallery < 0:
        raise ConfigurationError("gallery", got=suite.gallery, allowed="a number of pictures, 0 for none")
    for what, every in (("bare", suite.bare), ("free", suite.free), ("memory utility", suite.memory.utility)):
        if every < 0:
            raise ConfigurationError(what, got=every, allowed="every so many-th repetition, or 0 for never")
    seeds = range(suite.first, suite.first + suite.seeds)
    if seeds[0] not in TEST_SEEDS or seeds[-1] not in TEST_SEEDS:
        raise ConfigurationError(
            "seeds", got=f"{seeds[0]} to {seeds[-1]}", allowed=f"{TEST_SEEDS[0]} to {TEST_SEEDS[-1]}, for tests"
        )


def _check_memory(suite: Suite) -> None:
    memory, tasks = suite.memory, len(suite.base_tasks)
    if not 0 <= memory.start * tasks <= len(START_SEEDS) or not 0 <= memory.pilot * tasks <= len(PILOT_SEEDS):
        raise ConfigurationError(
            "start, pilot", got=(memory.start, memory.pilot), allowed="10000 episodes in all tasks"
        )
    pilot = memory.epsilon == FROM_PILOT
    if pilot != bool(memory.pilot) or (not pilot and not isinstance(memory.epsilon, float)):
        allowed = 'a number, or "pilot" with pilot episodes'
        raise ConfigurationError("epsilon", got=(memory.epsilon, memory.pilot), allowed=allowed)
    if isinstance(memory.epsilon, float) and not 0.0 <= memory.epsilon < inf:
        raise ConfigurationError("epsilon", got=memory.epsilon, allowed="at least 0")
