"""Suites: which are valid, and what their fields mean."""

import itertools
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.synthetic.split import SCENE_SEEDS
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.evaluation.protocol.suite import (
    PILOT_SEEDS,
    START_SEEDS,
    TEST_SEEDS,
    Task,
    builtin_suites,
    check_suite,
    is_due,
    load_suite,
    parse_suite,
)
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.simulation.perception.depth_perception import DepthPerception
from dualbrain.simulation.tasks.families import LEVELS, TASK_FAMILIES, make_task, task_families_for
from tests.evaluation.sample_rows import SUITE


@pytest.fixture
def suite():
    return parse_suite(SUITE, "tiny.toml")


@pytest.mark.parametrize("name", builtin_suites())
def test_built_in_suites_are_valid(name):
    found = load_suite(name)
    assert found.name == name
    assert build_units(found, "fly")


def test_seed_ranges_are_disjoint(suite):
    for one, other in itertools.combinations((PILOT_SEEDS, START_SEEDS, TEST_SEEDS, *SCENE_SEEDS.values()), 2):
        assert not set(one) & set(other)
    assert {seed for unit in build_units(suite, "start") for seed in unit.seeds} <= set(START_SEEDS)


def test_only_suite_paper_uses_the_scenes_on_which_memory_was_developed():
    def scenes(name):
        suite = load_suite(name)
        return set(range(suite.first, suite.first + suite.seeds))

    others = set(builtin_suites()) - {"paper", "smoke"}  # the latter tests no hypothesis
    assert others >= {"scenes", "cross", "ablations", "refusals", "attacks", "large", "eyes"}
    for name in others:
        assert not scenes("paper") & scenes(name), name
        assert min(scenes(name)) >= 40_010


def test_a_task_may_name_its_methods(suite):
    first, *rest = suite.tasks
    some = msgspec.structs.replace(suite, tasks=(msgspec.structs.replace(first, methods=("B3",)), *rest))
    assert {unit.method for unit in build_units(some, "fly") if unit.task.name == first.name} == {"B3"}
    with pytest.raises(UnknownNameError, match="B9"):
        parse_suite(SUITE.replace(b"family = ", b'methods = ["B9"]\nfamily = ', 1), "tiny.toml")


def test_an_additional_measurement_is_due_by_the_repetition_alone():
    assert [k for k in range(10) if is_due(5, k)] == [0, 5]
    assert all(is_due(1, k) and not is_due(0, k) for k in range(10))
    parse_suite(SUITE + b"utility = 5\n", "tiny.toml")
    with pytest.raises(ConfigurationError, match="free"):
        parse_suite(b"free = -1\n" + SUITE, "tiny.toml")
    for line in (b"utility = true", b"utility = -1"):
        with pytest.raises(ConfigurationError, match="utility"):
            parse_suite(SUITE + line, "tiny.toml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (b'methods = ["B9"]', "B9"),
        (b"runs = 9", "no more runs than seeds"),
        (b"first = 3", "for tests"),
        (b'robots = ["base"]', "can have"),
        (b"colour = 3", "colour"),
    ],
)
def test_an_invalid_suite_is_rejected_with_the_reason(change, message):
    key = change.split()[0]
    kept = [line for line in SUITE.splitlines() if not line.startswith(key)]
    with pytest.raises((ConfigurationError, UnknownNameError), match=message):
        parse_suite(b"\n".join([change, *kept]), "x.toml")


@pytest.mark.parametrize(
    ("before", "change", "message"),
    [
        (b'["B1", "B3", "M"]', b'["B1", "B1", "B3"]', "methods of suite tiny: got 'B1 twice'"),
        (b"seeds = 4", b'seeds = 4\nrobots = ["panda", "panda"]', "panda twice"),
        (b"[memory]", b'[[tasks]]\nfamily = "clutter_grasp"\n[memory]', "clutter_grasp I twice"),
        (b"[memory]", b'robots = ["panda", "panda"]\n[memory]', "robots of clutter_grasp I .*panda twice"),
        (b"[memory]", b'methods = ["B1", "B1"]\n[memory]', "methods of clutter_grasp I .*B1 twice"),
        (b"seeds = 4", b"seeds = 4\nplanning_time = -1.0", "planning_time"),
        (b"seeds = 4", b"seeds = 4\nplanning_time = inf", "planning_time"),
        (b"seeds = 4", b"seeds = 4\ngallery = -4", "gallery"),
        (b"start = 2", b"start = 2\nepsilon = -1.0", "epsilon"),
        (b"start = 2", b"start = 2\nepsilon = nan", "epsilon"),
        (b'"tiny"', b'"a/b"', "name of the suite"),
        (b'"tiny"', b'".."', "name of the suite"),
        (b'"tiny"', b'""', "name of the suite"),
    ],
)
def test_duplicates_and_values_that_would_fail_later_are_rejected_when_the_suite_is_read(before, change, message):
    assert before in SUITE
    with pytest.raises(ConfigurationError, match=message):
        parse_suite(SUITE.replace(before, change), "x.toml")


@pytest.mark.parametrize(
    ("family", "robot", "shown"),
    [
        (family, robot, not TASK_FAMILIES[family].mobile and family != "dynamic_obstacle")
        for robot in ("panda", "base")
        for family in task_families_for(robot)
    ],
)
def test_methods_with_depth_perception_get_no_task_that_it_cannot_perceive(suite, family, robot, shown):
    for level in LEVELS:
        here = msgspec.structs.replace(
            suite, methods=("B3", "B3-depth"), robots=(robot,), tasks=(Task(family=family, level=level),)
        )
        spec = make_task(family, level, TEST_SEEDS.start, robot).spec
        camera = SimpleNamespace(views=())
        if shown:
            check_suite(here)
            DepthPerception(spec, camera)
        else:
            with pytest.raises(ConfigurationError, match="without people"):
                DepthPerception(spec, camera)
            with pytest.raises(ConfigurationError, match="Leave out B3-depth"):
                check_suite(here)
            check_suite(msgspec.structs.replace(here, tasks=(Task(family=family, level=level, methods=("B3",)),)))
