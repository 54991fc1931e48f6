"""Results folders, complete, damaged or unfinished, as read by `report`, `compare` and `--again`."""

import os
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from dualbrain.cli.evaluation.results import last_run_date, load_results, reproduction_command
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.cli.main import run_command_line
from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.analysis.failure_taxonomy import PAPER_CLASSES, failure_class_of, paper_class_of
from dualbrain.evaluation.planners.answer_cache import AnswerCache
from dualbrain.evaluation.protocol.suite import load_suite, parse_suite
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.results.parquet import RESULTS_FILE, read_results, write_results
from dualbrain.evaluation.runner.provenance import collect_provenance
from dualbrain.evaluation.runner.runner import Runner
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.planner.protocol import STOP
from dualbrain.records import Proposal
from tests.evaluation.sample_rows import COLLISION, SUITE, episode_row, fake_result_lines
from tests.planner.sample_requests import plan_request

PAGES = Path(__file__).parents[2] / "docs" / "results"


def test_an_episode_is_repeated_with_the_suite_of_its_results(tmp_path, capsys):
    assert (
        run_command_line(
            [
                "evaluate",
                "--suite",
                "smoke",
                "--methods",
                "B1",
                "--episodes",
                "1",
                "--jobs",
                "1",
                "--out",
                str(tmp_path),
            ]
        )
        == 0
    )
    key = load_results(tmp_path)[0][0].key
    for name in ("config.json", "fly.jsonl"):  # the repository contains only the table
        (tmp_path / name).unlink()
    assert run_command_line(["evaluate", "--suite", "scenes", "--out", str(tmp_path), "--again", key]) == 0
    assert "as recorded" in capsys.readouterr().err
    assert run_command_line(["evaluate", "--out", str(tmp_path), "--again", "nothing"]) == 5
    assert key in capsys.readouterr().err
    assert run_command_line(["evaluate", "--jobs", "-1"]) == 2


def test_commands_read_results(rows, suite, tmp_path, capsys):
    config = {"suite": msgspec.to_builtins(suite), "methods": {}, "origin": {"code": "abc"}}
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        write_results(rows, config, tmp_path / name / RESULTS_FILE)
    assert run_command_line(["report", str(tmp_path / "one"), "--gallery", "0", "--json"]) == 0
    hypotheses = msgspec.json.decode(capsys.readouterr().out)
    assert [one["name"] for one in hypotheses] == ["H1", "H2", "H3"]
    assert "## Hypotheses" in (tmp_path / "one" / "page" / "report.md").read_text()
    assert (tmp_path / "one" / "report.html").stat().st_size > 20_000
    assert run_command_line(["compare", str(tmp_path / "one"), str(tmp_path / "two")]) == 0
    assert "The results are the same" in capsys.readouterr().out
    assert run_command_line(["compare", str(tmp_path / "one"), str(tmp_path / "two"), "--all"]) == 0
    assert "| B1 | success | 0.0 % |" in capsys.readouterr().out
    missing, page = tmp_path / "missing", tmp_path / "page"
    page.mkdir()
    (page / "report.md").write_text("Again: `dualbrain evaluate --suite attacks --out attacks`")
    for command in (["report"], ["compare", str(tmp_path / "one")]):
        assert run_command_line([*command, str(missing)]) == 5
        assert f"dualbrain evaluate --suite SUITE --out {missing}" in capsys.readouterr().err
        assert run_command_line([*command, str(page)]) == 5
        error = capsys.readouterr().err
        assert "into another folder" in error
        assert "--out" not in error
        assert run_command_line([*command, str(tmp_path / "one" / RESULTS_FILE)]) == 5
        assert "Name its folder" in capsys.readouterr().err


def test_an_unfinished_evaluation_is_read_from_its_logs(tmp_path):
    """Before the table is written there are only logs; a folder without a finished episode has no results."""
    suite = parse_suite(SUITE, "tiny.toml")
    runner = Runner(suite, tmp_path, clock=lambda: 0.0, on_progress=lambda progress: None)
    runner.write_config({"code": "abc"})
    with pytest.raises(ConfigurationError, match=rf"contains no finished episode.*--suite FILE.toml --out {tmp_path}"):
        load_results(tmp_path)
    run = next(unit for unit in build_units(suite, "fly") if unit.method == "M")
    for line in list(fake_result_lines(run))[:4]:
        runner.log("fly").append(line)
    found, config, read_suite = load_results(tmp_path)
    assert found == runner.rows()
    assert [one.key for one in found] == [run.row_key(order) for order in range(4)]
    assert (config["origin"], read_suite) == ({"code": "abc"}, suite)
    write_results(found, config, tmp_path / RESULTS_FILE)
    assert load_results(tmp_path)[0] == found
    runner.log("fly").append(list(fake_result_lines(run))[4])  # resumed after the table was written
    os.utime(tmp_path / RESULTS_FILE, ns=(0, 0))
    assert len(load_results(tmp_path)[0]) == 5


@pytest.fixture
def unfinished(tmp_path):
    """A runner of the suite `smoke` with two finished episodes."""
    runner = Runner(load_suite("smoke"), tmp_path / "unfinished", clock=time.perf_counter, on_progress=print)
    runner.write_config(collect_provenance())
    for unit in build_units(runner.suite, "fly")[:2]:
        runner.log("fly").append(next(iter(fake_result_lines(unit))))
    return runner


def test_the_error_states_the_complete_command_to_resume(unfinished, capsys):
    (unfinished.out / "fly.jsonl").unlink()
    assert run_command_line(["report", str(unfinished.out)]) == 5
    assert f"Resume the evaluation: dualbrain evaluate --suite smoke --out {unfinished.out}" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [b"{", b"[]", b"\xff"])
def test_a_damaged_configuration_is_reported_with_its_file(unfinished, capsys, damage):
    out = unfinished.out
    (out / "config.json").write_bytes(damage)
    for command in (
        ["report", out],
        ["evaluate", "--out", out, "--jobs", "1"],
        ["evaluate", "--dry-run", "--out", out],
    ):
        assert run_command_line(list(map(str, command))) == 5
        error = capsys.readouterr().err
        assert "The configuration of the results is damaged" in error
        assert f"Restore a copy, or name another --out. {out / 'config.json'}" in error
        assert "Traceback" not in error
    write_results(unfinished.rows(), {"suite": msgspec.to_builtins(unfinished.suite), "origin": {}}, out / RESULTS_FILE)
    os.utime(out / RESULTS_FILE, ns=(0, 0))  # resumed after the table was written
    assert run_command_line(["report", str(out)]) == 0
    assert "left out: Episodes that finished after results.parquet was written" in capsys.readouterr().err


@pytest.mark.parametrize("field", ["wall_s", "key"])
def test_an_incomplete_line_is_reported_and_left_out(unfinished, capsys, field):
    path = unfinished.out / "fly.jsonl"
    first, second = map(msgspec.json.decode, path.read_bytes().splitlines())
    del second[field]
    path.write_bytes(msgspec.json.encode(first) + b"\n" + msgspec.json.encode(second) + b"\n")
    assert run_command_line(["report", str(unfinished.out)]) == 0
    assert f"left out: Line 2 of fly.jsonl (Object missing required field `{field}`)" in capsys.readouterr().err
    page = (unfinished.out / "page" / "report.md").read_text()
    assert "Line 2 of fly.jsonl" in page.partition("## Not measured")[2]
    assert "1 episodes" in page
    for options in ((), ("--dry-run",)):
        assert (
            run_command_line(["evaluate", "--suite", "smoke", "--jobs", "1", "--out", str(unfinished.out), *options])
            == 5
        )
        error = capsys.readouterr().err
        assert "Line 2 of fly.jsonl is damaged" in error
        assert f"Delete it (with memory, all lines of its run), and its episode is run again. {path}" in error


def test_an_incomplete_line_of_the_plan_log_is_reported(unfinished, capsys):
    unfinished.log("plan").append({"key": "B3 #0", "asked": 1})
    assert run_command_line(["evaluate", "--suite", "smoke", "--dry-run", "--out", str(unfinished.out)]) == 5
    assert "Line 1 of plan.jsonl is damaged" in capsys.readouterr().err


def test_a_damaged_answer_is_left_out_and_requested_again(unfinished, capsys):
    plans = AnswerCache(unfinished.out / "plans")
    for instruction in ("put the cube down", "pick the cube up"):
        plans.put(
            "it",
            plan_request(instruction=instruction),
            Proposal(text="{}", finish_reason=STOP, planner="it", constrained_by="", timings={"total": 1.0}),
        )
    damaged = next(iter((unfinished.out / "plans").glob("*.json")))
    damaged.write_bytes(damaged.read_bytes()[:20])
    assert run_command_line(["report", str(unfinished.out)]) == 0
    assert f"left out: The answer in plans/{damaged.name}, which is damaged" in capsys.readouterr().err
    assert len(plans.read_all()) == 1
    known = [plans.get("it", plan_request(instruction=one)) for one in ("put the cube down", "pick the cube up")]
    assert known.count(None) == 1


def test_a_report_has_the_date_of_its_last_episode(tmp_path):
    for name, day in (("results.parquet", 20_000), ("fly.jsonl", 10_000)):
        (tmp_path / name).write_text("")
        os.utime(tmp_path / name, (86_400 * day, 86_400 * day))
    assert last_run_date(tmp_path, {"flown": "2001-01-01"}) == "1997-05-19"
    (tmp_path / "fly.jsonl").unlink()
    assert last_run_date(tmp_path, {"flown": "2001-01-01"}) == "2001-01-01"
    assert last_run_date(tmp_path, {}) == "2024-10-04"


def test_a_suite_that_no_options_reproduce_needs_a_file(tmp_path):
    builtin = load_suite("smoke")
    for other in (
        msgspec.structs.replace(builtin, name="mine"),
        msgspec.structs.replace(builtin, shots=builtin.shots + 1),
    ):
        assert "--suite FILE.toml" in reproduction_command(other, tmp_path / "there")


def test_the_reproduction_command_yields_the_same_suite(tmp_path):
    paper = ("paper", "B1,M", "200", "panda", "base=transformers:base-135m")
    for *options, target in ((*paper, "an500"), ("paper", "", "0", "", "", ""), ("attacks", "", "0", "base", "", "")):
        planner = options[4] or "adapted=adapter:x"
        suite = override_suite(options[0], options[1], int(options[2]), options[3], planner, target=target)
        command = reproduction_command(suite, tmp_path / "there").split()
        assert command[:2] == ["dualbrain", "evaluate"]
        stated = dict(zip(command[2::2], command[3::2], strict=True))
        assert stated.pop("--out") == "there"
        again = [stated.get(f"--{name}", "") for name in ("suite", "methods", "episodes", "robots", "planner")]
        assert stated.get("--target", "") == target
        count = int(again[2] or 0)
        assert override_suite(again[0], again[1], count, again[3], again[4], target=target) == suite


def test_a_full_disk_leaves_the_old_results_and_is_reported(tmp_path):
    path = tmp_path / "results.parquet"
    write_results([episode_row("B3", seed=1, repetition=0)], {"suite": {}}, path)
    before = path.read_bytes()
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from dualbrain.errors import DualbrainError\n"
        "from dualbrain.evaluation.results.parquet import write_results\n"
        "from tests.evaluation.sample_rows import episode_row\n"
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))\n"
        "try: write_results([episode_row('B3', seed=2, repetition=0)], {'suite': {}}, Path(sys.argv[1]))\n"
        "except (OSError, DualbrainError) as error: print('reported', type(error).__name__)\n"
    )
    run = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False)
    assert run.stdout.startswith("reported"), run.stderr
    assert path.read_bytes() == before


def test_results_are_read_as_written(tmp_path):
    rows = [
        episode_row(),
        episode_row("B1", Delta=None, frequency=None, violations=(COLLISION,), trace_h=[], trace_t=[], trace_delta=[]),
        episode_row("M", answers=[["{", "length"], ["{}", "stop"]], instruction='ä "quoted" | line\n'),
    ]
    write_results(rows, {"suite": {"name": "x"}}, tmp_path / "results.parquet")
    assert read_results(tmp_path / "results.parquet") == (rows, {"suite": {"name": "x"}})


def test_results_without_newer_columns_can_be_read(monkeypatch, tmp_path):
    """A column that the file lacks has the default of its field; one without a default is required."""
    fields = msgspec.structs.fields(EpisodeRow)
    newer = {"over_speed_share", "fragile_force", "physics_warnings"}
    row = episode_row(over_speed_share=0.5, fragile_force=3.0, physics_warnings=1)
    for left_out in (newer, {"severity"}):
        older = tuple(one for one in fields if one.name not in left_out)
        with monkeypatch.context() as patch:
            patch.setattr(msgspec.structs, "fields", lambda kind, older=older: older)
            write_results([row], {}, tmp_path / "results.parquet")
        if left_out is newer:
            assert read_results(tmp_path / "results.parquet")[0] == [episode_row()]
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_results(tmp_path / "results.parquet")


def test_the_stored_results_of_the_paper_have_a_class_for_every_failure():
    """Rows of the first version; none of their broken glasses is a failure of the drives."""
    rows, _ = read_results(PAGES / "cross" / "results.parquet")
    assert all(bool(failure_class_of(row)) != row.success for row in rows)
    broken = [row for row in rows if not row.success and any(v.kind == "force_fragile" for v in row.violations)]
    assert not {failure_class_of(row) for row in broken} & {"drive", "grasp", "load lost", "false success"}
    assert {paper_class_of(row) for row in broken} <= set(PAPER_CLASSES)


def test_a_file_that_is_not_parquet_is_rejected(tmp_path):
    (tmp_path / "results.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(ConfigurationError, match="no complete Parquet file"):
        read_results(tmp_path / "results.parquet")


def test_results_of_an_earlier_version_are_read_without_the_newest_columns():
    folder = Path(__file__).parents[2] / "docs" / "results" / "scenes"
    rows, config = read_results(folder / RESULTS_FILE)
    assert len(rows) > 100
    assert config
    assert all(row.margin_causes == [] for row in rows)
