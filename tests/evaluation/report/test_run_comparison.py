"""Comparison of two evaluations: changes on common cases, corrected p values, configuration differences."""

import msgspec
import numpy as np

from dualbrain.cli.main import run_command_line
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Task, parse_suite
from dualbrain.evaluation.report.run_comparison import MACHINE_DEPENDENT_METRICS, changes_table, compute_changes
from dualbrain.evaluation.results.parquet import RESULTS_FILE, write_results
from tests.evaluation.sample_rows import SUITE, episode_row


def two_evaluations(runs=8, **values):
    """Two evaluations of B3; in the second, each field in `values` is a function of the run."""
    before = [episode_row("B3", run, seed=run) for run in range(runs)]
    later = [{name: value_of(run) for name, value_of in values.items()} for run in range(runs)]
    return before, [msgspec.structs.replace(one, **new) for one, new in zip(before, later, strict=True)]


def test_changes_state_the_direction_on_common_cases():
    before = [episode_row("B3", run, seed=run, frequency=0.20 + 0.01 * run) for run in range(8)]
    after = [episode_row("B3", run, seed=run, frequency=0.10 + 0.01 * run) for run in range(10)]
    lines = {line[1]: line for line in changes_table(compute_changes(before, after)).rows}
    assert lines["intervention frequency"][-1] == "better"
    assert lines["intervention frequency"][-2] == "8"
    assert lines["success"][-1] == "identical"
    assert METRIC_BY_NAME["intervention frequency"].better_sign == -1


def test_the_conclusion_follows_the_corrected_p():
    """Six of eight clusters improved: the interval excludes 0, but the corrected p value of several tests does not."""
    evaluations = two_evaluations(frequency=lambda k: 0.1 + 0.12 * (k < 2), severity=lambda k: k % 2)
    changes = {one.metric.name: one for one in compute_changes(*evaluations)}
    found = changes["intervention frequency"]
    assert found.comparison.high < 0.0
    assert found.comparison.p < 0.05 < found.p
    assert found.conclusion == "no clear change"
    assert changes["success"].conclusion == "identical"
    one_cluster = {one.metric.name: one for one in compute_changes(*two_evaluations(1, frequency=lambda k: 0.1))}
    assert one_cluster["intervention frequency"].conclusion == "not known"
    assert one_cluster["success"].conclusion == "identical"


def test_identical_and_machine_dependent_metrics_do_not_enlarge_the_correction():
    slower = two_evaluations(gate_s=lambda k: 1.0, filter_us=lambda k: [80.0 + k] * 3, severity=lambda k: 0.1 + k)
    changes = {one.metric.name: one for one in compute_changes(*slower)}
    assert changes["severity"].p == changes["severity"].comparison.p == 2 / 2**8
    for name in MACHINE_DEPENDENT_METRICS:
        assert np.isnan(changes[name].p)
        assert changes[name].conclusion == "machine-dependent"
    line = next(line for line in changes_table(compute_changes(*slower)).rows if line[1] == "gate time")
    assert line[4] == "–"


def test_compare_reports_configuration_differences(rows, tmp_path, capsys):
    ours = parse_suite(SUITE, "tiny.toml")
    theirs = msgspec.structs.replace(
        ours,
        methods=("B1", "B3"),
        planners={"base": "base-135m"},
        description="Another.",
        tasks=(*ours.tasks, Task(family="edge_rescue", level="II")),
    )
    for name, suite, code in (("one", ours, "abc"), ("two", theirs, "def")):
        arms = {method: METHODS[method] for method in suite.methods}
        config = {"suite": suite, "methods": arms, "origin": {"code": code, "python": "3"}, "adapters": {}}
        config = msgspec.json.decode(msgspec.json.encode(config))
        (tmp_path / name).mkdir()
        write_results(rows[:1] if name == "one" else rows, config, tmp_path / name / RESULTS_FILE)
    lines = [
        ("origin.code", "abc", "def"),
        ("suite.methods", "M", "–"),
        ("suite.planners.base", "template", "base-135m"),
        ("suite.tasks", "–", "edge_rescue II errand all"),
    ]
    pair = [str(tmp_path / "one"), str(tmp_path / "two")]
    assert run_command_line(["compare", *pair]) == 0
    output = capsys.readouterr().out
    for line in lines:
        assert f"| {' | '.join(line)} |" in output
    assert "python" not in output
    assert run_command_line(["compare", *pair, "--json"]) == 0
    encoded = msgspec.json.decode(capsys.readouterr().out)
    assert encoded["configuration"] == {entry: {"before": a, "after": b} for entry, a, b in lines}
    found = next(one for one in encoded["changes"] if one["metric"] == "success")
    assert found == {
        "method": "B1",
        "metric": "success",
        "unit": "rate",
        "change": 0.0,
        "low": None,
        "high": None,
        "p": None,
        "clusters": 1,
        "word": "identical",
    }


def write_evaluation(folder, rows):
    config = msgspec.json.decode(msgspec.json.encode({"suite": parse_suite(SUITE, "tiny.toml"), "methods": {}}))
    folder.mkdir()
    write_results(rows, config, folder / RESULTS_FILE)
    return str(folder)


def test_the_command_prints_only_what_changed_and_is_known(tmp_path, capsys):
    def rows(frequency):
        return [
            episode_row("B3", run=seed, seed=seed, repetition=0, frequency=frequency + seed / 1000, instruction="a")
            for seed in range(12)
        ]

    before, after = write_evaluation(tmp_path / "one", rows(0.5)), write_evaluation(tmp_path / "two", rows(0.1))
    assert run_command_line(["compare", before, before]) == 0
    same = capsys.readouterr().out
    assert "The configurations are the same." in same
    assert "The results are the same" in same
    assert "|" not in same
    assert run_command_line(["compare", before, after]) == 0
    shown = capsys.readouterr().out
    assert [line.split(" | ")[1] for line in shown.splitlines() if line.startswith("| B3")] == [
        "intervention frequency",
        "intervention frequency, on task",
    ]
    assert "better" in shown
    assert "identical; `--all` shows them" in shown
    assert run_command_line(["compare", before, after, "--all"]) == 0
    assert capsys.readouterr().out.count("| B3") > 3


def test_changes_pair_equal_cases_of_different_runs():
    def evaluation(runs, first=0):
        return [
            episode_row("B3", run=seed % runs, seed=seed, repetition=0, frequency=seed / 100, instruction="a")
            for seed in range(first, first + 10)
        ]

    for before, after in (
        (evaluation(5), evaluation(2)),
        (evaluation(10), evaluation(1)),
        (evaluation(5), evaluation(5, first=1)),
    ):
        lines = {line[1]: line for line in changes_table(compute_changes(before, after)).rows}
        assert lines["intervention frequency"][-1] == "identical"
    other = [msgspec.structs.replace(one, instruction="b") for one in evaluation(5)]
    assert not changes_table(compute_changes(evaluation(5), other)).rows
