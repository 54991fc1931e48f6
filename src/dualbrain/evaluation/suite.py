"""A suite as data: which tasks, methods and planners, how many episodes, with which seeds."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import msgspec

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.evaluation.method import Method, find_method
from dualbrain.evaluation.seeds import PILOT, START, TEST

SUFFIX = ".toml"
FROM_PILOT = "pilot"


class Task(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One family at one level; `robots` empty: those of the suite."""

    family: str
    level: str = "I"
    robots: tuple[str, ...] = ()


class MemoryPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How methods with memory begin. `start`: episodes that are flown into the ledger from which all of them start.

    `epsilon` is ε, or `"pilot"`: the median Δ of the successes among `pilot` episodes of B3 by the base planner, frozen
    before any test. `utility`: the planner is asked again without each exemplar.
    """

    start: int = 0
    epsilon: float | str = 0.003
    pilot: int = 0
    utility: bool = False


class Suite(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that decides what is done; the resolved suite stands beside its results.

    Every method flies `seeds` scenes of each task, each `repetitions` times. The scenes are dealt to `runs` runs; a
    method with memory flies a run in its order with a fresh ledger, and runs are the unit of statistics of all methods.
    `planners` names a planner for each part that methods ask for (`base`, `prompted`, `adapted`, …); `adapters` names
    the card of an adapter, for its cost. `bare`: each contract is flown once more, unfiltered in the bare scene, for
    the seconds lost.
    """

    name: str
    says: str
    methods: tuple[str, ...]
    tasks: tuple[Task, ...]
    planners: dict[str, str]
    robots: tuple[str, ...] = ("panda",)
    seeds: int = 1
    repetitions: int = 1
    runs: int = 1
    first: int = TEST.start
    shots: int = 1
    planning_time: float = 2.0
    bare: bool = False
    gallery: int = 6
    memory: MemoryPart = MemoryPart()
    adapters: dict[str, str] = {}

    @property
    def arms(self) -> tuple[Method, ...]:
        """The methods; raises `UnknownName`."""
        return tuple(find_method(name) for name in self.methods)

    @property
    def episodes(self) -> int:
        """Episodes of one method in one task on one robot."""
        return self.seeds * self.repetitions

    def robots_of(self, task: Task) -> tuple[str, ...]:
        """The robots that fly `task`."""
        return task.robots or self.robots


def shipped() -> tuple[str, ...]:
    """Names of the suites that come with the package."""
    folder = resources.files("dualbrain.evaluation").joinpath("suites")
    return tuple(sorted(file.name.removesuffix(SUFFIX) for file in folder.iterdir() if file.name.endswith(SUFFIX)))


def open_suite(name: str) -> Suite:
    """The suite called `name`, or the one in a TOML file; raises `UnknownName`, or `InvalidSetup` with the field."""
    if not name.endswith(SUFFIX):
        if name not in shipped():
            raise UnknownName("suite", name, shipped(), owner="dualbrain (a TOML file also works)")
        data = resources.files("dualbrain.evaluation").joinpath("suites", name + SUFFIX).read_bytes()
    else:
        try:
            data = Path(name).read_bytes()
        except OSError as error:
            raise InvalidSetup("suite file", got=error.strerror, allowed="a readable TOML file", fix=name) from error
    return read_suite(data, name)


def read_suite(data: bytes, name: str) -> Suite:
    """The suite in `data`, checked."""
    try:
        suite = msgspec.toml.decode(data, type=Suite)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidSetup("suite", got=str(error), allowed="a suite as in docs/evaluation.md", fix=name) from error
    check_suite(suite)
    return suite


def check_suite(suite: Suite) -> None:
    """Refuse a suite that cannot be flown as it is meant; raises `InvalidSetup` and `UnknownName`."""
    for arm in suite.arms:
        if arm.asks not in suite.planners and arm.asks != "adversary":
            fix = f"Add `{arm.asks} = …` to [planners], or leave out {arm.name}."
            raise InvalidSetup(f"planners of suite {suite.name}", got=sorted(suite.planners), allowed=arm.asks, fix=fix)
    if min(suite.seeds, suite.repetitions, suite.runs, suite.shots) < 1 or suite.runs > suite.seeds:
        got = (suite.seeds, suite.repetitions, suite.runs)
        raise InvalidSetup("seeds, repetitions, runs", got=got, allowed="at least 1 each, and no more runs than seeds")
    if not suite.tasks or not suite.methods or not suite.robots:
        raise InvalidSetup(f"suite {suite.name}", got="nothing to do", allowed="tasks, methods and robots")
    seeds = range(suite.first, suite.first + suite.seeds)
    if seeds[0] not in TEST or seeds[-1] not in TEST:
        raise InvalidSetup("seeds", got=f"{seeds[0]} to {seeds[-1]}", allowed=f"{TEST[0]} to {TEST[-1]}, for tests")
    memory = suite.memory
    if not 0 <= memory.start <= len(START) or not 0 <= memory.pilot <= len(PILOT):
        raise InvalidSetup("start, pilot", got=(memory.start, memory.pilot), allowed="0 to 10000 episodes")
    pilot = memory.epsilon == FROM_PILOT
    if pilot != bool(memory.pilot) or (not pilot and not isinstance(memory.epsilon, float)):
        allowed = 'a number, or "pilot" with pilot episodes'
        raise InvalidSetup("epsilon", got=(memory.epsilon, memory.pilot), allowed=allowed)
