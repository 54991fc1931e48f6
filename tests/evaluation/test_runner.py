"""The runner: what is done is not done again, whatever was killed, and results do not depend on it."""

import itertools
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

import dualbrain
from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import registry_hashes
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.synthetic.split import SCENE_SEEDS
from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.errors import ConfigurationError, MissingDependencyError, UnknownNameError
from dualbrain.evaluation.episodes.episode_cache import EpisodeCache
from dualbrain.evaluation.planners.answer_cache import AnswerCache
from dualbrain.evaluation.planners.factory import (
    RANDOM_PLANNERS,
    PlannerFactory,
    PlannerSources,
    check_planners,
    planner_name,
)
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.evaluation.protocol.method import METHODS, find_method
from dualbrain.evaluation.protocol.suite import (
    PILOT_SEEDS,
    START_SEEDS,
    TEST_SEEDS,
    MemorySettings,
    Task,
    builtin_suites,
    check_suite,
    is_due,
    load_suite,
    parse_suite,
)
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.results.parquet import read_results, write_results
from dualbrain.evaluation.runner import preflight
from dualbrain.evaluation.runner.provenance import REPORTING, git_revision
from dualbrain.evaluation.runner.run_ledgers import RunFolder, plasticity_rule
from dualbrain.evaluation.runner.runner import STAGES, Runner, pilot_epsilon
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.evaluation.runner.worker_pool import ProcessPool, SerialPool
from dualbrain.evaluation.runner.workload import Workload, compute_workload
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.registry import planner_names
from dualbrain.robots.loader import BUILTIN_ROBOTS
from dualbrain.simulation.perception.depth_perception import DepthPerception
from dualbrain.simulation.tasks.families import LEVELS, TASK_FAMILIES, make_task, task_families_for
from tests.evaluation.sample_rows import COLLISION, episode_row

SUITE = b"""
name = "tiny"
says = "for tests"
methods = ["B1", "B3", "M"]
seeds = 4
repetitions = 3
runs = 2
[planners]
base = "template"
[[tasks]]
family = "clutter_grasp"
[memory]
start = 2
"""


class Broken(RuntimeError):
    pass


@pytest.fixture
def suite():
    return parse_suite(SUITE, "tiny.toml")


def fake_result_lines(unit):
    """What a worker would yield, without flying."""
    for order, (seed, repetition) in enumerate(unit.order):
        if order >= unit.done:
            yield msgspec.to_builtins(
                episode_row(
                    unit.method, seed=seed, repetition=repetition, key=unit.row_key(order), cluster=unit.cluster
                )
            )


def runner(suite, out, told=None):
    return Runner(suite, out, clock=itertools.count().__next__, on_progress=(told if told is not None else []).append)


def test_every_method_flies_the_same_scenes_equally_often(suite):
    places = {}
    for unit in build_units(suite, "fly"):
        places.setdefault(unit.method, []).extend((unit.cluster, seed, k) for seed, k in unit.seed_repetition_pairs)
    assert len({frozenset(one) for one in places.values()}) == 1
    assert all(len(one) == len(set(one)) == 12 for one in places.values())


def test_a_run_with_memory_is_one_unit_with_its_scenes_again_and_again(suite):
    runs = [unit for unit in build_units(suite, "fly") if unit.method == "M"]
    assert [unit.n_episodes for unit in runs] == [6, 6]
    assert list(runs[0].seed_repetition_pairs) == [
        (40000, 0),
        (40002, 0),
        (40000, 1),
        (40002, 1),
        (40000, 2),
        (40002, 2),
    ]


def test_what_is_done_every_so_many_th_repetition_is_a_matter_of_the_repetition_alone():
    assert [k for k in range(10) if is_due(5, k)] == [0, 5]
    assert all(is_due(1, k) and not is_due(0, k) for k in range(10))
    parse_suite(SUITE + b"utility = 5\n", "tiny.toml")
    with pytest.raises(ConfigurationError, match="free"):
        parse_suite(b"free = -1\n" + SUITE, "tiny.toml")
    for said in (b"utility = true", b"utility = -1"):
        with pytest.raises(ConfigurationError, match="utility"):
            parse_suite(SUITE + said, "tiny.toml")


def test_a_task_may_be_for_some_methods_only(suite):
    first, *rest = suite.tasks
    some = msgspec.structs.replace(suite, tasks=(msgspec.structs.replace(first, methods=("B3",)), *rest))
    assert {unit.method for unit in build_units(some, "fly") if unit.task.name == first.name} == {"B3"}
    with pytest.raises(UnknownNameError, match="B9"):
        parse_suite(SUITE.replace(b"family = ", b'methods = ["B9"]\nfamily = ', 1), "tiny.toml")


def test_any_prefix_compares_the_same_runs(suite):
    first = [unit.cluster for unit in build_units(suite, "fly")]
    assert first == sorted(first)


def test_ranges_of_seeds_are_disjoint(suite):
    for one, other in itertools.combinations((PILOT_SEEDS, START_SEEDS, TEST_SEEDS, *SCENE_SEEDS.values()), 2):
        assert not set(one) & set(other)
    assert {seed for unit in build_units(suite, "start") for seed in unit.seeds} <= set(START_SEEDS)


def test_no_reported_suite_but_paper_flies_the_scenes_that_memory_was_mended_on():

    def scenes(name):
        suite = load_suite(name)
        return set(range(suite.first, suite.first + suite.seeds))

    others = set(builtin_suites()) - {"paper", "first", "smoke"}  # these two decide nothing
    assert others >= {"scenes", "cross", "ablations", "refusals", "attacks", "large", "eyes"}
    for name in others:
        assert not scenes("paper") & scenes(name), name
        assert min(scenes(name)) >= 40_010


def test_every_ledger_begins_with_random_valid_contracts_whoever_plans(suite):
    """A greedy planner says nearly the same every time: memory would have nothing to choose from."""
    planned = msgspec.structs.replace(suite, planners={"base": "base-135m"})
    (unit,) = build_units(planned, "start")
    assert unit.n_episodes == 2
    assert planner_name(planned, find_method(unit.method)) == "template"
    assert {find_method(unit.method).gate, find_method(unit.method).guard} == {"gate", True}


def test_what_was_cut_off_is_done_once(suite, tmp_path):
    """A crew that dies after every few lines, started again until nothing is left, does each episode exactly once."""
    done = []

    def dying(unit):
        for number, line in enumerate(fake_result_lines(unit)):
            if number == 2:
                raise Broken("cut")
            done.append(line["key"])
            yield line

    for _ in range(10):
        if runner(suite, tmp_path).run_stage("fly", SerialPool(dying)):
            break
    assert sorted(done) == sorted(set(done))
    assert len(runner(suite, tmp_path).rows()) == 36
    assert all("Broken: cut" in line["error"] for line in JsonlLog(tmp_path / "errors.jsonl").read())


def test_a_torn_line_is_not_counted(suite, tmp_path):
    journal = JsonlLog(tmp_path / "fly.jsonl")
    journal.append({"key": "a", "value": 1})
    with journal.path.open("ab") as file:
        file.write(b'{"key": "b", "val')
    assert [line["key"] for line in journal.read()] == ["a"]
    journal.append({"key": "c"})
    assert [line["key"] for line in journal.read()] == ["a", "c"]


def make_toy():
    """In a worker."""
    return fake_result_lines


def test_processes_bring_the_same_rows_as_one(suite, tmp_path):
    one, two = runner(suite, tmp_path / "one"), runner(suite, tmp_path / "two")
    assert one.run_stage("fly", SerialPool(fake_result_lines))
    assert two.run_stage("fly", ProcessPool(make_toy, 2))
    assert one.rows() == two.rows()


def make_deadly():
    def deadly(unit):
        yield from itertools.islice(fake_result_lines(unit), 1)
        if unit.method == "M":
            import os  # noqa: PLC0415

            os._exit(9)

    return deadly


def test_a_worker_that_dies_costs_its_unit_only(suite, tmp_path):
    told = []
    assert not runner(suite, tmp_path, told).run_stage("fly", ProcessPool(make_deadly, 2))
    assert sum("died with exit code 9" in progress.error for progress in told) == 2
    left = runner(suite, tmp_path).remaining_units("fly")
    assert [(unit.method, unit.done) for unit in left] == [("M", 1), ("M", 1)]


def make_hanging():
    def hanging(unit):
        yield from itertools.islice(fake_result_lines(unit), 1)
        while True:
            time.sleep(1.0)

    return hanging


def test_workers_that_hang_are_ended(suite, tmp_path):
    """By a clock on which an hour passes in 3.6 seconds; one that was still starting then is ended, too."""
    alone, told = msgspec.structs.replace(suite, methods=("M",)), []
    crew = ProcessPool(make_hanging, 2, clock=lambda: 1000.0 * time.monotonic())
    assert not runner(alone, tmp_path, told).run_stage("fly", crew)
    assert sum("exit code -9, after nothing was heard of it for 3600 s" in progress.error for progress in told) == 2


def test_results_of_another_suite_or_code_are_not_mixed(suite, tmp_path):
    runner(suite, tmp_path).write_config({"code": "aaa"})
    runner(suite, tmp_path).write_config({"code": "aaa"})
    with pytest.raises(ConfigurationError, match=r"origin\.code is bbb, was aaa"):
        runner(suite, tmp_path).write_config({"code": "bbb"})
    with pytest.raises(ConfigurationError, match=r"suite\.shots is 2, was 1"):
        runner(msgspec.structs.replace(suite, shots=2), tmp_path).write_config({"code": "aaa"})


def test_a_run_may_go_on_on_another_machine_and_says_on_which(suite, tmp_path, monkeypatch):
    runner(suite, tmp_path).write_config({"code": "aaa"})
    told = msgspec.json.decode((tmp_path / "config.json").read_bytes())["host"]
    assert set(told) == {"processor", "cores", "memory", "revision"}
    assert all(told.values())
    monkeypatch.setattr("dualbrain.evaluation.runner.runner.host", lambda: {"processor": "another"})
    runner(suite, tmp_path).write_config({"code": "aaa"})
    assert msgspec.json.decode((tmp_path / "config.json").read_bytes())["host"] == {"processor": "another"}


def test_the_revision_is_that_of_a_checkout_that_holds_the_code(tmp_path):
    package, installed = tmp_path / "package", tmp_path / "site"
    for folder in (package, installed):
        folder.mkdir()
        (folder / "__init__.py").write_text("")
    assert git_revision(package) == "no checkout"
    git = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e"]
    for words in (["init", "-q"], ["add", "package"], ["commit", "-qm", "one"]):
        subprocess.run([*git, *words], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    assert git_revision(package) == head[:12]
    (package / "__init__.py").write_text("changed")
    assert git_revision(package) == f"{head[:12]}-dirty"
    assert git_revision(installed) == "no checkout"  # it only lies there


def test_methods_may_be_added_to_what_was_flown_and_nothing_may_be_left_out(suite, tmp_path):
    few = msgspec.structs.replace(suite, methods=("B1", "B3"))
    more = msgspec.structs.replace(suite, methods=("B1", "B3", "P"), planners=suite.planners | {"adapted": "adapter:x"})
    cost = AdapterCost(id="x", base="base", samples=100, steps=50, size=1000, bootstrapped=False)
    runner(few, tmp_path).write_config({"code": "aaa"})
    runner(few, tmp_path).run_stage("fly", SerialPool(fake_result_lines))
    runner(more, tmp_path).write_config({"code": "aaa"}, {"adapted": cost})
    assert {unit.method for unit in runner(more, tmp_path).remaining_units("fly")} == {"P"}
    assert len(runner(more, tmp_path).rows()) == 24
    others = (
        few,
        msgspec.structs.replace(more, planners=more.planners | {"adapted": "adapter:y"}),
        msgspec.structs.replace(more, planners=more.planners | {"base": "base-135m"}),
    )
    for other, part in zip(others, ("suite.methods", "suite.planners", "suite.planners"), strict=True):
        with pytest.raises(ConfigurationError, match=part):
            runner(other, tmp_path).write_config({"code": "aaa"}, {"adapted": cost})
    with pytest.raises(ConfigurationError, match=r"adapters\.adapted is"):
        runner(more, tmp_path).write_config({"code": "aaa"}, {"adapted": msgspec.structs.replace(cost, steps=60)})


def test_reporting_code_has_no_part_in_an_episode():
    """The code that the provenance hash leaves out is not even loaded by a worker."""
    listed = subprocess.run(
        [sys.executable, "-c", "import dualbrain.evaluation.runner.worker, sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = listed.stdout.split()
    assert "dualbrain.evaluation.episodes.scoring" in loaded
    package = Path(dualbrain.__file__).parent
    for part in REPORTING:
        module = "dualbrain." + part.removesuffix(".py").replace("/", ".")
        assert (package / part).exists()
        assert not [name for name in loaded if name == module or name.startswith(f"{module}.")]


def test_epsilon_is_the_median_of_the_pilots_successes():
    rows = [
        episode_row(Delta=0.01),
        episode_row(Delta=0.02),
        episode_row(Delta=0.06),
        episode_row(Delta=9.0, success=False),
    ]
    assert pilot_epsilon(rows, ["panda"]) == {"panda": 0.02}
    quiet = [episode_row(Delta=0.0), episode_row(Delta=0.5 * DEAD_BAND), episode_row(Delta=0.0), episode_row(Delta=0.0)]
    assert pilot_epsilon([*rows, *quiet], ["panda"]) == {"panda": 0.02}  # what the filter did not touch says nothing
    assert pilot_epsilon(quiet, ["panda"]) == {"panda": DEAD_BAND}
    with pytest.raises(ConfigurationError, match="no success"):
        pilot_epsilon(rows, ["ur5e"])


def test_epsilon_and_episodes_that_are_damaged_are_told_or_made_again(suite, tmp_path):
    pilot = msgspec.structs.replace(suite, memory=MemorySettings(epsilon="pilot", pilot=2))
    (tmp_path / "epsilon.json").write_text("{")
    with pytest.raises(ConfigurationError, match=r"Delete it.*epsilon\.json"):
        runner(pilot, tmp_path).epsilon()
    case, once = make_case(suite.tasks[0], 40_000, "panda", 0), EpisodeCache(tmp_path / "once")
    once.put(case, METHODS["B1"], "it", episode_row("B1", first_stage=""))
    assert once.get(case, METHODS["B2"], "it", "another") is not None
    for kept in (tmp_path / "once").iterdir():
        kept.write_bytes(kept.read_bytes()[:30])
    assert once.get(case, METHODS["B2"], "it", "another") is None


def test_epsilon_that_was_cut_off_does_not_block_the_folder(suite, tmp_path, monkeypatch):
    told = [episode_row("B3", seed=1, repetition=0, Delta=0.002, success=True)]
    wanted = msgspec.structs.replace(suite, memory=msgspec.structs.replace(suite.memory, epsilon="pilot"))
    runner(wanted, tmp_path).log("pilot").append(msgspec.to_builtins(told[0]))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dualbrain.evaluation.runner.runner.write_durably", full)
    with pytest.raises(OSError, match="No space"):
        runner(wanted, tmp_path).epsilon()
    assert not (tmp_path / "epsilon.json").exists()
    monkeypatch.undo()
    assert runner(wanted, tmp_path).epsilon() == {"panda": 0.002}


def test_what_is_left_to_do_counts_what_is_asked_and_flown_beside(suite):
    """With memory every flight asks; every second repetition a free question, and a bare flight of the guarded."""
    told = msgspec.structs.replace(
        suite, planners={"base": "base-135m"}, free=2, bare=2, memory=MemorySettings(start=2, utility=3)
    )
    work = {stage: compute_workload(told, build_units(told, stage)) for stage in STAGES}
    assert work["start"] == Workload(2, 0)
    assert work["plan"] == Workload(0, 12)
    assert work["fly"] == Workload(36 + 2 * 8, 12 + 3 * 8 + 4 * MAX_RECALLED)
    drawn = msgspec.structs.replace(told, planners={"base": "template"})
    assert compute_workload(drawn, build_units(drawn, "fly")).requests == 0


def test_what_must_be_declined_is_asked_of_ledgers_of_errands():
    """All that is asked of one family begins with the same ledger, and nobody was shown how to do the impossible."""
    found = load_suite("refusals")
    assert {task.name for task in found.base_tasks} == {"clutter_grasp I", "mobile_navigation I"}
    starts = build_units(found, "start")
    assert [(unit.key, unit.task.ask, unit.task.wordings) for unit in starts] == [
        ("start panda clutter_grasp I", "errand", "all"),
        ("start base mobile_navigation I", "errand", "all"),
    ]
    assert {f"start {unit.robot} {unit.task.base_name}" for unit in build_units(found, "fly")} == {
        one.key for one in starts
    }


def test_a_question_that_nothing_binds_is_asked_apart(suite):
    arms = msgspec.structs.replace(suite, methods=("B1", "B3", "B1-free", "G-free"), planners={"base": "base-135m"})
    assert {unit.method for unit in build_units(arms, "plan")} == {"B1", "B1-free"}
    planners = PlannerFactory(arms, PlannerSources(Path(), Path()), AnswerCache(Path()))
    bound, free = (planners.get(METHODS[name], "panda").name for name in ("B1", "B1-free"))
    assert bound != free == planners.get(METHODS["B1"], "panda", constrained=False).name


def break_off(folder):
    with folder.step(1, None) as ledger:
        ledger.write_text("half")
        raise Broken


def test_each_step_of_a_run_starts_from_whole_steps(tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.open_episode(0, None) as ledger:
        ledger.write_text("one")
    with pytest.raises(Broken):
        break_off(folder)
    with folder.open_episode(1, None) as ledger:
        assert ledger.read_text() == "one"
        ledger.write_text("two")
    with folder.open_episode(1, None) as ledger:  # killed before its row was written: done again from the same start
        assert ledger.read_text() == "one"
        ledger.write_text("two again")
    with folder.open_episode(2, None) as ledger:
        ledger.write_text("three")
    folder.remove_old_ledgers(3)
    assert sorted(path.name for path in folder.path.iterdir()) == ["after-0002", "after-0003", "lock"]
    with folder.open_episode(2, None) as ledger:  # killed after it was tidied up, before its last row was written
        assert ledger.read_text() == "two again"
        ledger.write_text("three")
    assert (folder.folder_after(2) / "ledger.sqlite").read_text() == "two again"


def test_who_follows_a_worker_that_still_ends_its_episode_waits_for_it(tmp_path):
    folder, order = RunFolder(tmp_path / "run"), []

    def follow():
        with folder.open_episode(0, None) as ledger:
            order.append("second")
            ledger.write_text("second")

    second = threading.Thread(target=follow)
    with folder.open_episode(0, None) as ledger:
        second.start()
        second.join(0.2)
        order.append("first")
        ledger.write_text("first")
    second.join()
    assert order == ["first", "second"]
    assert (folder.folder_after(1) / "ledger.sqlite").read_text() == "second"


def test_the_rule_of_each_kind_of_memory():
    static, dynamic, success = (plasticity_rule(METHODS[name], 0.004) for name in ("B4", "M", "M-success"))
    assert static is None
    assert (dynamic.is_reinforcing(1, 0.003), dynamic.is_reinforcing(1, 0.005)) == (True, False)
    assert success.is_reinforcing(1, 1.9)
    assert success.update_map(0, 0.001) == success.update_map(0, 1.0)  # Δ says nothing any more
    assert plasticity_rule(METHODS["M-half"], 0.004).epsilon == 0.002


# --- suites and files --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", builtin_suites())
def test_shipped_suites_are_sound(name):
    found = load_suite(name)
    assert found.name == name
    assert build_units(found, "fly")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (b'methods = ["B9"]', "B9"),
        (b"runs = 9", "no more runs than seeds"),
        (b"first = 3", "for tests"),
        (b'robots = ["base"]', "can have"),
        (b"colour = 3", "colour"),
    ],
)
def test_an_unsound_suite_is_refused_with_its_reason(change, said):
    key = change.split()[0]
    kept = [line for line in SUITE.splitlines() if not line.startswith(key)]
    with pytest.raises((ConfigurationError, UnknownNameError), match=said):
        parse_suite(b"\n".join([change, *kept]), "x.toml")


@pytest.mark.parametrize(
    ("before", "change", "said"),
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
def test_what_would_be_counted_twice_or_fail_in_flight_is_refused_when_the_suite_is_read(before, change, said):
    assert before in SUITE
    with pytest.raises(ConfigurationError, match=said):
        parse_suite(SUITE.replace(before, change), "x.toml")


@pytest.mark.parametrize(
    ("family", "robot", "shown"),
    [
        (family, robot, not TASK_FAMILIES[family].mobile and family != "dynamic_obstacle")
        for robot in ("panda", "base")
        for family in task_families_for(robot)
    ],
)
def test_depth_cameras_are_given_no_task_that_they_cannot_show(suite, family, robot, shown):
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


def test_nobody_to_ask_is_told_before_anything_is_flown(suite):
    check_planners(suite)
    with pytest.raises(ConfigurationError, match="--planner adapted=adapter:ID"):
        check_planners(msgspec.structs.replace(suite, methods=("B3", "P")))
    with pytest.raises(ConfigurationError, match="what stays the same"):
        check_planners(msgspec.structs.replace(suite, planners={"base": "adapter:champion"}))
    with pytest.raises(ConfigurationError, match="Leave out B1-free"):
        check_planners(msgspec.structs.replace(suite, methods=("B3", "B1-free")))
    check_planners(msgspec.structs.replace(suite, methods=("B1-free",), planners={"base": "base-135m"}))


@pytest.mark.parametrize(
    ("planners", "said"),
    [
        ({"base": "nosuch"}, "'nosuch' is not a planner.*base-135m.*template"),
        ({"base": ""}, "'' is not a planner"),
        ({"base": "adapter:"}, "is not a planner"),
        ({"base": "transformers:template"}, "is not a planner"),
        ({"base": "transformers:x.gguf"}, "is not a planner"),
        ({"base": "shadow:ab@nosuch"}, "is not a planner"),
        ({"base": "shadow:ab@template"}, "is not a planner"),
        ({"base": "ftp://host/v1"}, "planner address"),
        ({"base": "template", "foo": "template"}, "'foo' is not a part.*adapted"),
        ({"base": "transformers:adapter:champion"}, "what stays the same"),
        ({"base": "shadow:ab"}, "what stays the same"),
    ],
)
def test_a_planner_or_a_part_that_nobody_knows_is_refused_by_its_name(suite, planners, said):
    with pytest.raises((ConfigurationError, UnknownNameError), match=said):
        check_planners(msgspec.structs.replace(suite, planners=planners))


@pytest.mark.parametrize(
    "name",
    [
        *RANDOM_PLANNERS,
        *planner_names(),
        *packaged_names(),
        "transformers:base-135m",
        "adapter:ab",
        "transformers:adapter:ab",
        "http://host:8000/v1#model",
        "vllm+http://host/v1",
        "my/model.gguf",
        "shadow:ab@base-135m",
    ],
)
def test_every_way_to_name_a_planner_passes_also_for_a_part_that_no_method_asks_for(suite, name):
    check_planners(msgspec.structs.replace(suite, planners={"base": name, "adapted_no_kl": name}))


def test_a_pilot_has_somebody_to_ask(suite):
    pilot = MemorySettings(epsilon="pilot", pilot=2)
    alone = msgspec.structs.replace(suite, methods=("PE",), planners={"prompted": "template"}, memory=pilot)
    with pytest.raises(ConfigurationError, match="planner of the pilot"):
        check_planners(alone)


def test_an_adapter_is_looked_for_and_must_have_been_taught_the_robot(suite, tmp_path):
    sources = PlannerSources(tmp_path, tmp_path)

    def looked_for(robot="panda", **planners):
        here = msgspec.structs.replace(suite, planners={"base": "template"} | planners, robots=(robot,))
        preflight.require_adapters(here, build_units(here, "fly"), sources)

    looked_for(adapted="base-135m", base="transformers:starter-135m")  # the model below them is not here
    for name in ("adapter:deadbeef", "transformers:adapter:deadbeef", "shadow:deadbeef@template"):
        with pytest.raises(UnknownNameError, match="deadbeef"):
            looked_for(adapted=name)
    with pytest.raises(MissingDependencyError):
        looked_for(adapted=f"adapter:{tmp_path}/none")
    taught = registry_hashes(read_adapter_card(packaged_folder("starter-135m")))
    untaught = next(robot for robot in BUILTIN_ROBOTS if robot not in taught)
    assert "clutter_grasp" in task_families_for(untaught)
    looked_for(untaught, adapted="starter-135m")  # nobody asks it here
    with pytest.raises(ConfigurationError, match=untaught):
        looked_for(untaught, base="starter-135m")


def test_a_model_file_that_is_not_there_is_missed_beforehand(tmp_path):
    with pytest.raises(MissingDependencyError, match="model file"):
        preflight.require_planner_files(str(tmp_path / "none.gguf"), "panda", PlannerSources(tmp_path, tmp_path))


@pytest.mark.parametrize(
    ("name", "methods", "planners"),
    [
        ("tiny", ("M",), {"template"}),
        ("large", ("M",), {"qwen2.5-coder-1.5b-instruct"}),
        ("large", ("B3",), {"qwen2.5-coder-1.5b-instruct"}),
        ("smoke", ("M",), {"base-135m"}),
    ],
)
def test_whoever_will_be_asked_is_looked_for_beforehand(suite, tmp_path, monkeypatch, name, methods, planners):
    chosen = suite if name == "tiny" else load_suite(name)
    chosen = msgspec.structs.replace(chosen, methods=methods)
    if name == "smoke":
        chosen = msgspec.structs.replace(chosen, planners={"base": "base-135m"})
    looked = set()
    monkeypatch.setattr(preflight, "require_planner_files", lambda name, robot, sources: looked.add(name))
    monkeypatch.setattr(preflight, "locate", lambda name, cache: None)
    units = [unit for stage in STAGES for unit in build_units(chosen, stage)]
    preflight.require_dependencies(chosen, units, PlannerSources(tmp_path, tmp_path))
    assert looked - {"template"} == planners - {"template"}


def test_a_full_disk_leaves_the_former_table_and_is_told(tmp_path):
    path = tmp_path / "results.parquet"
    write_results([episode_row("B3", seed=1, repetition=0)], {"suite": {}}, path)
    before = path.read_bytes()
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from dualbrain.errors import DualbrainError\n"
        "from dualbrain.evaluation.results.parquet import write_table\n"
        "from tests.evaluation.sample_rows import row\n"
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))\n"
        "try: write_table([row('B3', seed=2, repetition=0)], {'suite': {}}, Path(sys.argv[1]))\n"
        "except (OSError, DualbrainError) as error: print('told', type(error).__name__)\n"
    )
    run = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False)
    assert run.stdout.startswith("told"), run.stderr
    assert path.read_bytes() == before


def test_a_table_is_read_as_it_was_written(tmp_path):
    rows = [
        episode_row(),
        episode_row("B1", Delta=None, frequency=None, violations=(COLLISION,), trace_h=[], trace_t=[], trace_delta=[]),
        episode_row("M", answers=[["{", "length"], ["{}", "stop"]], instruction='ä "quoted" | line\n'),
    ]
    write_results(rows, {"suite": {"name": "x"}}, tmp_path / "results.parquet")
    assert read_results(tmp_path / "results.parquet") == (rows, {"suite": {"name": "x"}})


def test_a_file_that_is_no_table_is_refused(tmp_path):
    (tmp_path / "results.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(ConfigurationError, match="results"):
        read_results(tmp_path / "results.parquet")
