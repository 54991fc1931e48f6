"""Parts of an evaluation: they divide the work completely, and their merge is the evaluation of one process."""

import time

import msgspec
import pytest

from dualbrain.cli.main import run_command_line
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.core.storage.resumable_steps import exclusive_folder
from dualbrain.errors import ConfigurationError, MissingDependencyError, UsageError
from dualbrain.evaluation.protocol.suite import MemorySettings, load_suite, parse_suite
from dualbrain.evaluation.runner.parts.merge import merge_parts
from dualbrain.evaluation.runner.parts.part import Part
from dualbrain.evaluation.runner.parts.preparation import take_over_preparation
from dualbrain.evaluation.runner.runner import STAGES, Runner
from dualbrain.evaluation.runner.work_units import all_clusters, build_units
from dualbrain.evaluation.runner.worker_pool import SerialPool
from tests.evaluation.sample_rows import SUITE, fake_result_lines

CODE = {"code": "aaa"}


@pytest.fixture
def suite():
    return parse_suite(SUITE, "tiny.toml")


def run(suite, out, number=None, *, count=2, limit=None):
    """Run a part, or everything, with synthetic rows; with `limit`, each unit fails after so many."""
    whole = Runner(suite, out, clock=time.monotonic, on_progress=lambda progress: None)
    runner = whole.select_part(Part(count, number)) if number else whole
    runner.write_config(CODE)

    def lines(unit):
        for order, line in enumerate(fake_result_lines(unit)):
            if order == limit:
                raise RuntimeError("interrupted")
            yield line | {"wall_s": time.perf_counter()}

    for stage in STAGES:
        runner.run_stage(stage, SerialPool(lines))
    return runner


def without_times(rows):
    return [msgspec.structs.replace(row, wall_s=0.0) for row in rows]


@pytest.mark.parametrize("name", ["paper", "cross", "refusals", "reuse"])
@pytest.mark.parametrize("count", [1, 3, 4, None], ids=["1", "3", "4", "most"])
def test_parts_divide_the_units_and_hold_all_methods_of_a_cluster(name, count):
    suite = load_suite(name)
    roles = {"base": "base-135m", "prompted": "base-135m", "adapted": "template"}
    suite = msgspec.structs.replace(suite, planners=suite.planners | roles)
    count = count or len(all_clusters(suite))
    parts = [Part(count, number) for number in range(1, count + 1)]
    for stage in ("plan", "fly"):
        keys = [unit.key for part in parts for unit in part.units(suite, stage)]
        assert sorted(keys) == sorted(unit.key for unit in build_units(suite, stage))
    clusters = [{unit.cluster for unit in part.units(suite, "fly")} for part in parts]
    assert sum(map(len, clusters)) == len(set.union(*clusters)) == len(all_clusters(suite))
    assert max(map(len, clusters)) - min(map(len, clusters)) <= 1
    for part in parts:
        robots = {unit.robot for unit in part.units(suite, "fly")}
        assert {unit.robot for unit in part.units(suite, "pilot")} == (robots if suite.memory.pilot else set())
        assert {unit.robot for unit in part.units(suite, "start")} == robots


def test_another_order_of_tasks_or_fewer_methods_leave_the_clusters_of_a_part():
    suite = load_suite("paper")
    other = msgspec.structs.replace(suite, methods=("B1",), tasks=suite.tasks[::-1])
    for number in (1, 2, 3):
        assert Part(3, number).clusters(other) == Part(3, number).clusters(suite)


@pytest.mark.parametrize("text", ["0/2", "3/2", "1/3", "1", "a/b", "1/0", "-1/2", "", "1/2/3", "1/٢"])
def test_a_part_outside_the_division_is_refused(suite, text):
    with pytest.raises(UsageError, match="--part: got"):
        Part.parse(text, suite)


def test_merged_parts_are_the_evaluation_of_one_process_even_after_interruptions(suite, tmp_path):
    expected = run(suite, tmp_path / "one").rows()
    out = tmp_path / "parts"
    run(suite, out, 1)
    first = merge_parts(out)
    assert first.unfinished == {Part(2, 1): 0, Part(2, 2): 18}
    run(suite, out, 2, limit=1)
    assert 0 < merge_parts(out).unfinished[Part(2, 2)] < 18
    run(suite, out, 2)
    assert not any(merge_parts(out).unfinished.values())
    merged = Runner(suite, out, clock=time.monotonic, on_progress=lambda progress: None)
    assert without_times(merged.rows()) == without_times(expected)
    for stage in STAGES:
        keys = [line["key"] for line in merged.log(stage).read()]
        assert len(keys) == len(set(keys))
        assert not merged.remaining_units(stage)
    before = [merged.log(stage).read() for stage in STAGES]
    merge_parts(out)
    assert [merged.log(stage).read() for stage in STAGES] == before


def test_parts_of_different_configurations_are_not_merged(suite, tmp_path):
    run(suite, tmp_path, 1)
    run(msgspec.structs.replace(suite, shots=2), tmp_path, 2)
    with pytest.raises(ConfigurationError, match=r"Parts 1/2 and 2/2 have different configurations: suite\.shots"):
        merge_parts(tmp_path)
    assert not (tmp_path / "fly.jsonl").exists()


def test_parts_with_more_methods_are_another_configuration(suite, tmp_path):
    run(msgspec.structs.replace(suite, methods=("B1", "B3")), tmp_path, 1)
    run(suite, tmp_path, 2)
    with pytest.raises(ConfigurationError, match=r"suite\.methods"):
        merge_parts(tmp_path)


def test_rows_that_differ_in_more_than_times_are_not_merged(suite, tmp_path):
    for number in (1, 2):
        run(suite, tmp_path, number)
    log = Part(2, 2).folder(tmp_path) / "start.jsonl"
    lines = JsonlLog(log).read()
    log.unlink()
    for line in lines:
        JsonlLog(log).append(line | {"success": False})
    with pytest.raises(ConfigurationError, match=r"start panda clutter_grasp I #0.* in success.*--prepare-only"):
        merge_parts(tmp_path)


def test_different_epsilons_are_not_merged(suite, tmp_path):
    for number, value in ((1, 0.002), (2, 0.003)):
        run(suite, tmp_path, number)
        (Part(2, number).folder(tmp_path) / "epsilon.json").write_bytes(msgspec.json.encode({"panda": value}))
    with pytest.raises(ConfigurationError, match=r"different ε for panda: 0\.002 and 0\.003"):
        merge_parts(tmp_path)


def test_parts_of_two_divisions_or_renamed_parts_are_not_merged(suite, tmp_path):
    with pytest.raises(MissingDependencyError, match="--part 1/N"):
        merge_parts(tmp_path)
    run(suite, tmp_path, 1)
    run(suite, tmp_path, 1, count=1)
    with pytest.raises(ConfigurationError, match="different divisions: N is 1, 2"):
        merge_parts(tmp_path)
    Part(1, 1).folder(tmp_path).rename(Part(2, 2).folder(tmp_path))
    with pytest.raises(ConfigurationError, match="holds part 1/1, not 2/2"):
        merge_parts(tmp_path)


def test_a_part_at_work_is_not_merged(suite, tmp_path):
    run(suite, tmp_path, 1)
    with (
        exclusive_folder(Part(2, 1).folder(tmp_path)),
        pytest.raises(ConfigurationError, match="Another process works"),
    ):
        merge_parts(tmp_path)


def test_the_folder_of_a_part_does_not_take_other_results(suite, tmp_path):
    part = run(suite, tmp_path, 1)
    with pytest.raises(ConfigurationError, match="holds results of part 1/2 of the evaluation, not of all parts"):
        run(suite, part.out)
    run(suite, tmp_path / "whole")
    with pytest.raises(ConfigurationError, match="holds results of all parts of the evaluation, not of part"):
        Runner(
            suite, tmp_path / "whole", clock=time.monotonic, on_progress=lambda progress: None, part=Part(2, 1)
        ).check_config(CODE)


def test_a_part_takes_over_complete_preparation_only(suite, tmp_path):
    piloted = msgspec.structs.replace(suite, memory=MemorySettings(start=2, epsilon="pilot", pilot=2))
    whole = Runner(piloted, tmp_path, clock=time.monotonic, on_progress=lambda progress: None)
    part = whole.select_part(Part(2, 1))
    assert not take_over_preparation(whole, part)
    whole.write_config(CODE)
    whole.run_stage("pilot", SerialPool(fake_result_lines))
    assert not take_over_preparation(whole, part)
    whole.run_stage("start", SerialPool(fake_result_lines))
    epsilon = whole.epsilon()
    ledger = tmp_path / "start" / "start-panda" / "after-0002" / "ledger.sqlite"
    ledger.parent.mkdir(parents=True)
    ledger.write_text("prepared")
    assert take_over_preparation(whole, part)
    assert part.epsilon() == epsilon
    assert (part.out / ledger.relative_to(tmp_path)).read_text() == "prepared"
    assert not part.remaining_units("pilot")
    assert not part.remaining_units("start")
    assert part.remaining_units("fly")


def test_the_commands_run_parts_and_merge_them(tmp_path, capsys):
    suite_file, out = tmp_path / "two.toml", tmp_path / "out"
    methods = SUITE.replace(b'["B1", "B3", "M"]', b'["B3", "M"]').replace(b"seeds = 4", b"seeds = 2")
    suite_file.write_bytes(methods.replace(b"repetitions = 3", b"repetitions = 1").replace(b"start = 2", b"start = 1"))
    command = ["evaluate", "--suite", str(suite_file), "--jobs", "1", "--out", str(out)]
    assert run_command_line([*command, "--prepare-only"]) == 0
    assert run_command_line([*command, "--part", "1/2"]) == 0
    assert "start ledgers taken over" in capsys.readouterr().err
    assert run_command_line(["evaluate", "--merge", "--out", str(out), "--json"]) == 1
    printed = capsys.readouterr()
    assert f"--out {out} --part 2/2" in printed.err
    assert msgspec.json.decode(printed.out) == {"out": str(out), "episodes": 2, "whole": False, "left": ["2/2"]}
    assert run_command_line([*command, "--part", "2/2"]) == 0
    assert run_command_line(["evaluate", "--merge", "--out", str(out)]) == 0
    assert run_command_line(command) == 0, "the merged folder is complete"
    assert run_command_line(["report", str(out), "--gallery", "0"]) == 0
    assert run_command_line([*command, "--merge", "--part", "1/2"]) == 2
    assert run_command_line([*command, "--part", "3/2"]) == 2
