"""The runner: finished work is not repeated after a kill, and results do not depend on interruptions."""

import itertools
import threading
from pathlib import Path

import msgspec
import pytest

from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.evaluation.episodes.episode_cache import EpisodeCache
from dualbrain.evaluation.planners.answer_cache import AnswerCache
from dualbrain.evaluation.planners.factory import (
    PlannerFactory,
    PlannerSources,
    planner_name,
)
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.evaluation.protocol.method import METHODS, find_method
from dualbrain.evaluation.protocol.suite import (
    MemorySettings,
    load_suite,
    parse_suite,
)
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.runner import runner as runner_module
from dualbrain.evaluation.runner.run_ledgers import RunFolder, plasticity_rule
from dualbrain.evaluation.runner.runner import STAGES, Runner, pilot_epsilon, suite_from_config
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.evaluation.runner.worker_pool import ProcessPool, SerialPool
from dualbrain.evaluation.runner.workload import Workload, compute_workload
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from tests.evaluation.sample_rows import SUITE, episode_row, fake_result_lines


class InterruptedUnitError(RuntimeError):
    pass


@pytest.fixture
def suite():
    return parse_suite(SUITE, "tiny.toml")


def runner(suite, out, progress=None):
    reports = progress if progress is not None else []
    return Runner(suite, out, clock=itertools.count().__next__, on_progress=reports.append)


def test_every_method_runs_the_same_scenes_equally_often(suite):
    places = {}
    for unit in build_units(suite, "fly"):
        places.setdefault(unit.method, []).extend((unit.cluster, seed, k) for seed, k in unit.seed_repetition_pairs)
    assert len({frozenset(one) for one in places.values()}) == 1
    assert all(len(one) == len(set(one)) == 12 for one in places.values())


def test_a_run_with_memory_is_one_unit_that_repeats_its_scenes(suite):
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


def test_any_prefix_compares_the_same_runs(suite):
    first = [unit.cluster for unit in build_units(suite, "fly")]
    assert first == sorted(first)


def test_every_ledger_starts_with_random_valid_contracts_for_every_planner(suite):
    """A greedily decoded planner would give nearly the same contract every time, and memory nothing to choose from."""
    planned = msgspec.structs.replace(suite, planners={"base": "base-135m"})
    (unit,) = build_units(planned, "start")
    assert unit.n_episodes == 2
    assert planner_name(planned, find_method(unit.method)) == "template"
    assert {find_method(unit.method).gate, find_method(unit.method).guard} == {"gate", True}


def test_an_interrupted_unit_continues_and_runs_each_episode_once(suite, tmp_path):
    """A pool that fails after every few lines and is started until nothing is left runs each episode exactly once."""
    done = []

    def failing(unit):
        for number, line in enumerate(fake_result_lines(unit)):
            if number == 2:
                raise InterruptedUnitError("interrupted")
            done.append(line["key"])
            yield line

    for _ in range(10):
        if runner(suite, tmp_path).run_stage("fly", SerialPool(failing)):
            break
    assert sorted(done) == sorted(set(done))
    assert len(runner(suite, tmp_path).rows()) == 36
    assert all(
        "InterruptedUnitError: interrupted" in line["error"] for line in JsonlLog(tmp_path / "errors.jsonl").read()
    )


def make_fake_runner():
    """Called in a worker."""
    return fake_result_lines


def test_a_process_pool_gives_the_same_rows_as_a_serial_pool(suite, tmp_path):
    one, two = runner(suite, tmp_path / "one"), runner(suite, tmp_path / "two")
    assert one.run_stage("fly", SerialPool(fake_result_lines))
    assert two.run_stage("fly", ProcessPool(make_fake_runner, 2))
    assert one.rows() == two.rows()


def make_dying_runner():
    def dying(unit):
        yield from itertools.islice(fake_result_lines(unit), 1)
        if unit.method == "M":
            import os  # noqa: PLC0415

            os._exit(9)

    return dying


def test_a_worker_that_dies_costs_its_unit_only(suite, tmp_path):
    progress = []
    assert not runner(suite, tmp_path, progress).run_stage("fly", ProcessPool(make_dying_runner, 2))
    assert sum("died with exit code 9" in one.error for one in progress) == 2
    left = runner(suite, tmp_path).remaining_units("fly")
    assert [(unit.method, unit.done) for unit in left] == [("M", 1), ("M", 1)]


def test_results_of_another_suite_or_code_are_not_mixed(suite, tmp_path):
    runner(suite, tmp_path).write_config({"code": "aaa"})
    runner(suite, tmp_path).write_config({"code": "aaa"})
    with pytest.raises(ConfigurationError, match=r"origin\.code is bbb, was aaa"):
        runner(suite, tmp_path).write_config({"code": "bbb"})
    with pytest.raises(ConfigurationError, match=r"suite\.shots is 2, was 1"):
        runner(msgspec.structs.replace(suite, shots=2), tmp_path).write_config({"code": "aaa"})


def test_a_run_may_continue_on_another_machine_which_is_recorded(suite, tmp_path, monkeypatch):
    runner(suite, tmp_path).write_config({"code": "aaa"})
    host = msgspec.json.decode((tmp_path / "config.json").read_bytes())["host"]
    assert set(host) == {"processor", "cores", "memory", "revision"}
    assert all(host.values())
    monkeypatch.setattr(runner_module, "host_info", lambda: {"processor": "another"})
    runner(suite, tmp_path).write_config({"code": "aaa"})
    assert msgspec.json.decode((tmp_path / "config.json").read_bytes())["host"] == {"processor": "another"}


def test_methods_may_be_added_to_results_but_not_removed(suite, tmp_path):
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


def test_epsilon_is_the_median_of_the_successes_with_intervention():
    rows = [
        episode_row(Delta=0.01),
        episode_row(Delta=0.02),
        episode_row(Delta=0.06),
        episode_row(Delta=9.0, success=False),
    ]
    assert pilot_epsilon(rows, ["panda"]) == {"panda": 0.02}
    quiet = [episode_row(Delta=0.0), episode_row(Delta=0.5 * DEAD_BAND), episode_row(Delta=0.0), episode_row(Delta=0.0)]
    assert pilot_epsilon([*rows, *quiet], ["panda"]) == {"panda": 0.02}  # episodes without intervention do not count
    assert pilot_epsilon(quiet, ["panda"]) == {"panda": DEAD_BAND}
    with pytest.raises(ConfigurationError, match="No pilot episode of ur5e succeeded"):
        pilot_epsilon(rows, ["ur5e"])


def test_a_damaged_epsilon_is_an_error_and_a_damaged_cached_episode_is_ignored(suite, tmp_path):
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


def test_a_failed_write_of_epsilon_does_not_block_the_folder(suite, tmp_path, monkeypatch):
    row = episode_row("B3", seed=1, repetition=0, Delta=0.002, success=True)
    wanted = msgspec.structs.replace(suite, memory=msgspec.structs.replace(suite.memory, epsilon="pilot"))
    runner(wanted, tmp_path).log("pilot").append(msgspec.to_builtins(row))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(runner_module, "write_atomically", full)
    with pytest.raises(OSError, match="No space"):
        runner(wanted, tmp_path).epsilon()
    assert not (tmp_path / "epsilon.json").exists()
    monkeypatch.undo()
    assert runner(wanted, tmp_path).epsilon() == {"panda": 0.002}


def test_the_workload_counts_additional_requests_and_episodes(suite):
    """Methods with memory make a request per episode; in every second repetition there is an unconstrained request, and
    an episode without obstacles for methods with a filter.
    """
    chosen = msgspec.structs.replace(
        suite, planners={"base": "base-135m"}, free=2, bare=2, memory=MemorySettings(start=2, utility=3)
    )
    work = {stage: compute_workload(chosen, build_units(chosen, stage)) for stage in STAGES}
    assert work["start"] == Workload(2, 0)
    assert work["plan"] == Workload(0, 12)
    assert work["fly"] == Workload(36 + 2 * 8, 12 + 3 * 8 + 4 * MAX_RECALLED)
    drawn = msgspec.structs.replace(chosen, planners={"base": "template"})
    assert compute_workload(drawn, build_units(drawn, "fly")).requests == 0


def test_requests_to_be_declined_start_from_ledgers_of_feasible_tasks():
    """All requests of one family start from the same ledger, which shows no example of an infeasible request."""
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


def test_unconstrained_requests_are_planned_and_cached_apart(suite):
    chosen = msgspec.structs.replace(suite, methods=("B1", "B3", "B1-free", "G-free"), planners={"base": "base-135m"})
    assert {unit.method for unit in build_units(chosen, "plan")} == {"B1", "B1-free"}
    planners = PlannerFactory(chosen, PlannerSources(Path(), Path()), AnswerCache(Path()))
    constrained, free = (planners.get(METHODS[name], "panda").name for name in ("B1", "B1-free"))
    assert constrained != free == planners.get(METHODS["B1"], "panda", constrained=False).name


def interrupt_episode(folder):
    with folder.open_episode(1, None) as ledger:
        ledger.write_text("half")
        raise InterruptedUnitError


def test_each_episode_of_a_run_starts_from_a_complete_ledger(tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.open_episode(0, None) as ledger:
        ledger.write_text("one")
    with pytest.raises(InterruptedUnitError):
        interrupt_episode(folder)
    with folder.open_episode(1, None) as ledger:
        assert ledger.read_text() == "one"
        ledger.write_text("two")
    with folder.open_episode(1, None) as ledger:  # killed before its row was logged: run again from the same ledger
        assert ledger.read_text() == "one"
        ledger.write_text("two again")
    with folder.open_episode(2, None) as ledger:
        ledger.write_text("three")
    folder.remove_old_ledgers(3)
    assert sorted(path.name for path in folder.path.iterdir()) == ["after-0002", "after-0003", "lock"]
    with folder.open_episode(2, None) as ledger:  # killed after the clean-up, before its last row was logged
        assert ledger.read_text() == "two again"
        ledger.write_text("three")
    assert (folder.folder_after(2) / "ledger.sqlite").read_text() == "two again"


def test_a_run_whose_old_ledgers_were_removed_before_their_rows_were_logged_continues(tmp_path):
    folder = RunFolder(tmp_path / "run")
    for order in range(4):
        with folder.open_episode(order, None) as ledger:
            ledger.write_text(f"after {order + 1}")
    assert [folder.first_episode_to_run(done) for done in range(5)] == [0, 1, 2, 3, 4]
    folder.remove_old_ledgers(4)
    assert [folder.first_episode_to_run(done) for done in range(5)] == [0, 0, 0, 3, 4]


def test_the_ledger_of_an_episode_is_on_the_disk_before_its_row_is_logged(tmp_path, monkeypatch):
    synced = []

    def sync(folder):
        synced.append({path.name for path in folder.iterdir()})

    for name in ("fsync_tree", "fsync_folder"):
        monkeypatch.setattr(f"dualbrain.evaluation.runner.run_ledgers.{name}", sync)
    with RunFolder(tmp_path / "run").open_episode(0, None) as ledger:
        ledger.write_text("one")
    assert synced == [{"ledger.sqlite"}, {"after-0001", "lock"}]


@pytest.mark.parametrize("robot", ["/tmp/robot.json", "other"])
def test_the_robot_of_a_stored_suite_is_a_packaged_one(suite, tmp_path, robot):
    stored = {"suite": msgspec.to_builtins(suite)}
    assert suite_from_config(stored, tmp_path) == suite
    for part in (stored["suite"], stored["suite"]["tasks"][0]):
        before = part["robots"]
        part["robots"] = [robot]
        with pytest.raises(UnknownNameError, match="packaged robot"):
            suite_from_config(stored, tmp_path)
        part["robots"] = before


def test_a_worker_waits_for_one_that_is_still_finishing_its_episode(tmp_path):
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


def test_each_kind_of_memory_has_its_learning_rule():
    static, dynamic, success = (plasticity_rule(METHODS[name], 0.004) for name in ("B4", "M", "M-success"))
    assert static is None
    assert (dynamic.is_reinforcing(1, 0.003), dynamic.is_reinforcing(1, 0.005)) == (True, False)
    assert success.is_reinforcing(1, 1.9)
    assert success.update_map(0, 0.001) == success.update_map(0, 1.0)  # Δ has no influence
    assert plasticity_rule(METHODS["M-half"], 0.004).epsilon == 0.002
