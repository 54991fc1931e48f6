"""Suites as data: tasks, methods, planners, number of episodes, seeds."""

from __future__ import annotations

import re
from collections import Counter
from importlib import resources
from itertools import product
from math import inf
from pathlib import Path
from typing import Literal

import msgspec

from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.core.untrusted.toml_document import TomlFault, parse_toml
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.robots.loader import SIMULATED_ROBOTS
from dualbrain.safety.target.boards import find_board
from dualbrain.simulation.tasks.families import Level, RequestType, supports_depth_perception, task_families_for

PILOT_SEEDS = range(10_000, 20_000)
"""Seeds of the pilot episodes that determine ε, before any test."""
START_SEEDS = range(20_000, 30_000)
"""Seeds of the episodes in the ledger from which all methods with memory start."""
TEST_SEEDS = range(40_000, 50_000)
"""Seeds of the reported episodes."""
MAX_FILE_BYTES = 1 << 20
TOML_SUFFIX = ".toml"
FROM_PILOT = "pilot"
NAME_PATTERN = r"\w[\w .-]*"
"""Names that a suite may have."""


class Task(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A task family at one level, and the type of request: the family's task, or a request to be declined.

    `wordings`: all wordings of the instruction, or only those that no training data contains. Without `robots` or
    `methods`, those of the suite apply.
    """

    family: str
    level: Level = "I"
    ask: RequestType = "errand"
    wordings: Literal["all", "held_out"] = "all"
    robots: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Family and level, and the type of request unless it is the family's own task."""
        return self.base_name + (f" {self.ask}" if self.ask != "errand" else "")

    @property
    def base_name(self) -> str:
        """The name of the feasible task of the same family and level, used for its pilot and its start ledger."""
        return f"{self.family} {self.level}"


class MemorySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the methods with memory.

    `start`: number of episodes with random valid contracts in the ledger from which all methods start. `epsilon`: ε, or
    `"pilot"`: the median Δ of the successes with intervention among `pilot` episodes of B3 with the base planner,
    determined before any test. `utility`: in every `utility`-th repetition the planner is also asked without each
    exemplar (0: never).
    """

    start: int = 0
    epsilon: float | str = 0.003
    pilot: int = 0
    utility: int = 0


class Suite(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"description": "says"}, kw_only=True):
    """The complete definition of an evaluation; the resolved suite is stored with its results.

    Every method runs on `seeds` scenes of each task, `repetitions` times each, starting with seed `first`. The scenes
    are divided into `runs` runs: a method with memory executes a run in order with its own ledger, and runs are the
    unit of statistics of all methods. `planners` names a planner for each role (`base`, `prompted`, `adapted`, …),
    which may make `shots` attempts; planning takes `planning_time` [s] of simulated time.

    Additional measurements, each in every n-th repetition (0: never): `bare`, the contract once more without filter in
    the scene without obstacles, for the time lost by intervention; `free`, the first request once more with
    unconstrained decoding, for compliance. `gallery`: number of failures shown with images in the report. `target`: an
    emulated board on which the filter of every guarded method runs, "" for this process.
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
    target: str = ""
    memory: MemorySettings = MemorySettings()

    @property
    def resolved_methods(self) -> tuple[Method, ...]:
        """The methods; raises `UnknownNameError`."""
        return tuple(find_method(name) for name in self.methods)

    @property
    def episodes_per_task(self) -> int:
        """Number of episodes of one method in one task with one robot."""
        return self.seeds * self.repetitions

    @property
    def base_tasks(self) -> tuple[Task, ...]:
        """The feasible task of each family and level once, with the robots of all tasks of that family and level."""
        found: dict[tuple[str, Level], dict[str, None]] = {}
        for task in self.tasks:
            found.setdefault((task.family, task.level), {}).update(dict.fromkeys(self.robots_of(task)))
        return tuple(
            Task(family=family, level=level, robots=tuple(robots)) for (family, level), robots in found.items()
        )

    def robots_of(self, task: Task) -> tuple[str, ...]:
        """The robots of `task`: its own, or those of the suite that have its family."""
        return task.robots or tuple(robot for robot in self.robots if task.family in task_families_for(robot))

    def includes(self, method: str, task: Task) -> bool:
        """Whether `method` runs `task`: every method does, unless the task names its methods."""
        return not task.methods or method in task.methods

    def n_clusters(self, method: str) -> int:
        """Upper bound of the number of statistical units of `method`.

        The units are runs; in tasks to be declined they are sentences, at most one per episode.
        """
        return sum(
            len(self.robots_of(task)) * (self.runs if task.ask == "errand" else self.episodes_per_task)
            for task in self.tasks
            if self.includes(method, task)
        )


def is_due(every: int, repetition: int) -> bool:
    """Whether a measurement of every `every`-th repetition (0: never) is due in `repetition`, for all methods alike."""
    return every > 0 and repetition % every == 0


def builtin_suites() -> tuple[str, ...]:
    """Names of the suites that come with the package."""
    folder = resources.files("dualbrain.evaluation").joinpath("suites")
    return tuple(
        sorted(file.name.removesuffix(TOML_SUFFIX) for file in folder.iterdir() if file.name.endswith(TOML_SUFFIX))
    )


def load_suite(name: str) -> Suite:
    """The built-in suite called `name`, or the suite in the TOML file `name`.

    Raises:
        UnknownNameError: no built-in suite, method, family or robot has the name.
        ConfigurationError: the file cannot be read, or a field of the suite is invalid.
    """
    if not name.endswith(TOML_SUFFIX):
        if name not in builtin_suites():
            raise UnknownNameError("suite", name, builtin_suites(), owner="dualbrain (a TOML file also works)")
        data = resources.files("dualbrain.evaluation").joinpath("suites", name + TOML_SUFFIX).read_bytes()
    else:
        data = read_regular_file(Path(name), MAX_FILE_BYTES)
        if isinstance(data, FileRefusal):
            raise ConfigurationError.stating(f"The suite file cannot be read. {data.sentence}", fix=data.fix)
    return parse_suite(data, name)


def parse_suite(data: bytes, name: str) -> Suite:
    """The suite in the TOML document `data` with the file name `name`; raises as `load_suite`."""
    fix = f"docs/reference/evaluation.md describes its fields. {name}"
    tables = parse_toml(data)
    if isinstance(tables, TomlFault):
        raise ConfigurationError.stating(f"The suite is invalid: {tables.problem}.", fix=fix)
    try:
        suite = msgspec.convert(tables, Suite)
    except msgspec.ValidationError as error:
        raise ConfigurationError.stating(f"The suite is invalid: {error}.", fix=fix) from error
    check_suite(suite)
    return suite


def check_suite(suite: Suite) -> None:
    """Check everything that would fail or be counted wrongly later; raises `ConfigurationError`, `UnknownNameError`."""
    _ = suite.resolved_methods
    for check in (
        _check_name,
        check_robots,
        _check_target,
        _check_unique,
        _check_tasks,
        _check_perception,
        _check_numbers,
        _check_memory,
    ):
        check(suite)


def _check_name(suite: Suite) -> None:
    """The name becomes the name of a folder."""
    if not re.fullmatch(NAME_PATTERN, suite.name):
        allowed = "letters, digits, spaces and . _ -, the first a letter or digit"
        raise ConfigurationError("name of the suite", got=suite.name, allowed=allowed)


def check_robots(suite: Suite) -> None:
    """The robots are packaged ones with a plant: the name of a robot in a suite opens no file.

    Raises `UnknownNameError`.
    """
    for robot in (*suite.robots, *(robot for task in suite.tasks for robot in task.robots)):
        if robot not in SIMULATED_ROBOTS:
            raise UnknownNameError("packaged robot", robot[:80], SIMULATED_ROBOTS, owner=f"suite {suite.name}")


def _check_target(suite: Suite) -> None:
    if suite.target:
        find_board(suite.target)


def _check_unique(suite: Suite) -> None:
    """A method, robot or task that is named twice would run once and be counted twice."""
    named = {"methods": suite.methods, "robots": suite.robots, "tasks": tuple(task.name for task in suite.tasks)}
    for task in suite.tasks:
        named |= {f"methods of {task.name}": task.methods, f"robots of {task.name}": task.robots}
    for what, names in named.items():
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            got = f"{', '.join(twice)} twice"
            raise ConfigurationError(f"{what} of suite {suite.name}", got=got, allowed="each once")


def _check_tasks(suite: Suite) -> None:
    if not suite.tasks or not suite.methods or not suite.robots:
        raise ConfigurationError.stating(f"Suite {suite.name} must name at least one task, method and robot.")
    for task in suite.tasks:
        for method in task.methods:
            find_method(method)
        for robot in suite.robots_of(task):
            if task.family not in task_families_for(robot):
                raise UnknownNameError("family", task.family, task_families_for(robot), owner=robot)
        if not suite.robots_of(task):
            sentence = f"No robot of suite {suite.name} ({', '.join(suite.robots)}) can have the task {task.name}."
            raise ConfigurationError.stating(sentence, fix="Name a robot that has it, or leave the task out.")


def _check_perception(suite: Suite) -> None:
    """Depth perception recognises neither people nor rooms, so methods with it cannot run tasks that have them."""
    seeing = [method for method in suite.resolved_methods if method.perception == "depth"]
    for method, task in product(seeing, suite.tasks):
        hidden = [
            robot for robot in suite.robots_of(task) if not supports_depth_perception(task.family, task.level, robot)
        ]
        if suite.includes(method.name, task) and hidden:
            fix = f"Leave out {method.name}, or name the task's methods without it."
            allowed = "a table without people"
            raise ConfigurationError(f"task of {method.name}", got=task.name, allowed=allowed, fix=fix)


def _check_numbers(suite: Suite) -> None:
    if min(suite.seeds, suite.repetitions, suite.runs, suite.shots) < 1 or suite.runs > suite.seeds:
        got = (suite.seeds, suite.repetitions, suite.runs)
        raise ConfigurationError(
            "seeds, repetitions, runs", got=got, allowed="at least 1 each, and no more runs than seeds"
        )
    if not 0.0 <= suite.planning_time < inf:
        allowed = "a finite number of simulated seconds, at least 0"
        raise ConfigurationError("planning_time", got=suite.planning_time, allowed=allowed)
    if suite.gallery < 0:
        raise ConfigurationError("gallery", got=suite.gallery, allowed="a number of images, 0 for none")
    for what, every in (("bare", suite.bare), ("free", suite.free), ("memory utility", suite.memory.utility)):
        if every < 0:
            raise ConfigurationError(what, got=every, allowed="n for every n-th repetition, or 0 for never")
    seeds = range(suite.first, suite.first + suite.seeds)
    if seeds[0] not in TEST_SEEDS or seeds[-1] not in TEST_SEEDS:
        raise ConfigurationError(
            "seeds", got=f"{seeds[0]} to {seeds[-1]}", allowed=f"{TEST_SEEDS[0]} to {TEST_SEEDS[-1]}, for tests"
        )


def _check_memory(suite: Suite) -> None:
    memory, tasks = suite.memory, len(suite.base_tasks)
    if not 0 <= memory.start * tasks <= len(START_SEEDS) or not 0 <= memory.pilot * tasks <= len(PILOT_SEEDS):
        allowed = f"at most {len(START_SEEDS)} episodes over all tasks"
        raise ConfigurationError("start, pilot", got=(memory.start, memory.pilot), allowed=allowed)
    pilot = memory.epsilon == FROM_PILOT
    if pilot != bool(memory.pilot) or (not pilot and not isinstance(memory.epsilon, float)):
        allowed = 'a number, or "pilot" with pilot episodes'
        raise ConfigurationError("epsilon", got=(memory.epsilon, memory.pilot), allowed=allowed)
    if isinstance(memory.epsilon, float) and not 0.0 <= memory.epsilon < inf:
        raise ConfigurationError("epsilon", got=memory.epsilon, allowed="a finite number, at least 0")
