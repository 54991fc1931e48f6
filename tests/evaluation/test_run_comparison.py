"""What changed between two evaluations: place by place, corrected, and in what they were set up otherwise."""

import msgspec
import numpy as np

from dualbrain.cli.main import run_command_line
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Task, parse_suite
from dualbrain.evaluation.report.run_comparison import MACHINE_DEPENDENT_METRICS, changes_table, compute_changes
from dualbrain.evaluation.results.parquet import RESULTS_FILE, write_results
from tests.evaluation.sample_rows import SUITE, episode_row


def flown_twice(runs=8, **values):
    """Two evaluations in which B3 differs in all of `values`: before, and after by the run."""
    before = [episode_row("B3", run, seed=run) for run in range(runs)]
    later = [{name: of(run) for name, of in values.items()} for run in range(runs)]
    return before, [msgspec.structs.replace(one, **new) for one, new in zip(before, later, strict=True)]


def test_changes_name_the_direction_and_only_common_places():
    before = [episode_row("B3", run, seed=run, frequency=0.20 + 0.01 * run) for run in range(8)]
    after = [episode_row("B3", run, seed=run, frequency=0.10 + 0.01 * run) for run in range(10)]
    lines = {line[1]: line for line in changes_table(before, after).rows}
    assert lines["intervention frequency"][-1] == "better"
    assert lines["intervention frequency"][-2] == "8"
    assert lines["success"][-1] == "the same"
    assert METRIC_BY_NAME["intervention frequency"].better_sign == -1


def test_what_a_change_is_called_goes_by_the_corrected_p():
    """Six clusters of eight got better: the interval leaves out 0, and among several tests that is too little."""
    told = {
        one.metric.name: one
        for one in compute_changes(*flown_twice(frequency=lambda k: 0.1 + 0.12 * (k < 2), severity=lambda k: k % 2))
    }
    found = told["intervention frequency"]
    assert found.comparison.high < 0.0
    assert found.comparison.p < 0.05 < found.p
    assert found.conclusion == "no clear change"
    assert told["success"].conclusion == "the same"
    one_cluster = {one.metric.name: one for one in compute_changes(*flown_twice(1, frequency=lambda k: 0.1))}
    assert one_cluster["intervention frequency"].conclusion == one_cluster["success"].conclusion == "not known"


def test_what_is_alike_or_of_the_machine_makes_the_correction_of_nothing_larger():
    slower = flown_twice(gate_s=lambda k: 1.0, filter_us=lambda k: [80.0 + k] * 3, severity=lambda k: 0.1 + k)
    told = {one.metric.name: one for one in compute_changes(*slower)}
    assert told["severity"].p == told["severity"].comparison.p == 2 / 2**8
    for name in MACHINE_DEPENDENT_METRICS:
        assert np.isnan(told[name].p)
        assert told[name].conclusion == "of the machine"
    line = next(line for line in changes_table(*slower).rows if line[1] == "gate time")
    assert line[4] == "–"


def test_in_what_two_evaluations_were_set_up_otherwise_is_told(rows, tmp_path, capsys):
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
    said = capsys.readouterr().out
    for line in lines:
        assert f"| {' | '.join(line)} |" in said
    assert "python" not in said
    assert run_command_line(["compare", *pair, "--json"]) == 0
    told = msgspec.json.decode(capsys.readouterr().out)
    assert told["configuration"] == {what: {"before": a, "after": b} for what, a, b in lines}
    found = next(one for one in told["changes"] if one["metric"] == "success")
    assert found == {
        "method": "B1",
        "metric": "success",
        "unit": "rate",
        "change": 0.0,
        "low": None,
        "high": None,
        "p": None,
        "clusters": 1,
        "word": "not known",
    }
    assert run_command_line(["compare", *pair[:1] * 2]) == 0
    assert "None." in capsys.readouterr().out


def test_changes_pair_places_however_they_were_dealt_to_runs():
    def flown(runs, first=0):
        return [
            episode_row("B3", run=seed % runs, seed=seed, repetition=0, frequency=seed / 100, instruction="a")
            for seed in range(first, first + 10)
        ]

    def told(before, after):
        return next(line for line in changes_table(before, after).rows if line[1] == "intervention frequency")

    for before, after in ((flown(5), flown(2)), (flown(10), flown(1)), (flown(5), flown(5, first=1))):
        assert told(before, after)[-1] == "the same"
    other = [msgspec.structs.replace(one, instruction="b") for one in flown(5)]
    assert not changes_table(flown(5), other).rows
