"""A folder of results, whole, damaged or under way, as `report`, `compare` and `--again` read it."""

import os
import subprocess
import sys
import time

import msgspec
import pytest

from dualbrain.cli.evaluation.results import last_run_date, load_results, reproduction_command
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.cli.main import run_command_line
from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.planners.answer_cache import AnswerCache
from dualbrain.evaluation.protocol.suite import load_suite, parse_suite
from dualbrain.evaluation.results.parquet import RESULTS_FILE, read_results, write_results
from dualbrain.evaluation.runner.provenance import collect_provenance
from dualbrain.evaluation.runner.runner import Runner
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.planner.protocol import STOP
from dualbrain.records import Proposal
from tests.evaluation.sample_rows import COLLISION, SUITE, episode_row, fake_result_lines
from tests.planner.sample_requests import plan_request


def test_an_episode_of_results_is_flown_again_whatever_suite_is_named(tmp_path, capsys):
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
    for name in ("config.json", "fly.jsonl"):  # what a repository keeps is the table
        (tmp_path / name).unlink()
    assert run_command_line(["evaluate", "--suite", "first", "--out", str(tmp_path), "--again", key]) == 0
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
    told = msgspec.json.decode(capsys.readouterr().out)
    assert [one["name"] for one in told] == ["H1", "H2", "H3"]
    assert "## Hypotheses" in (tmp_path / "one" / "page" / "report.md").read_text()
    assert (tmp_path / "one" / "report.html").stat().st_size > 20_000
    assert run_command_line(["compare", str(tmp_path / "one"), str(tmp_path / "two")]) == 0
    assert "| B1 | success | 0.0 % |" in capsys.readouterr().out
    nothing, page = tmp_path / "nothing", tmp_path / "page"
    page.mkdir()
    (page / "report.md").write_text("Again: `dualbrain evaluate --suite attacks --out attacks`")
    for command in (["report"], ["compare", str(tmp_path / "one")]):
        assert run_command_line([*command, str(nothing)]) == 5
        assert f"dualbrain evaluate --suite SUITE --out {nothing}" in capsys.readouterr().err
        assert run_command_line([*command, str(page)]) == 5
        told = capsys.readouterr().err
        assert "into another folder" in told
        assert "--out" not in told
        assert run_command_line([*command, str(tmp_path / "one" / RESULTS_FILE)]) == 5
        assert "Name the folder" in capsys.readouterr().err


def test_a_run_under_way_can_be_read(tmp_path):
    """Before the table is written there are only journals; a folder in which nothing is flown yet has no results."""
    suite = parse_suite(SUITE, "tiny.toml")
    runner = Runner(suite, tmp_path, clock=lambda: 0.0, on_progress=lambda progress: None)
    runner.write_config({"code": "abc"})
    with pytest.raises(ConfigurationError, match=rf"no episode that is finished.*--suite FILE.toml --out {tmp_path}"):
        load_results(tmp_path)
    run = next(unit for unit in build_units(suite, "fly") if unit.method == "M")
    for line in list(fake_result_lines(run))[:4]:
        runner.log("fly").append(line)
    found, config, told = load_results(tmp_path)
    assert found == runner.rows()
    assert [one.key for one in found] == [run.row_key(order) for order in range(4)]
    assert (config["origin"], told) == ({"code": "abc"}, suite)
    write_results(found, config, tmp_path / RESULTS_FILE)
    assert load_results(tmp_path)[0] == found
    runner.log("fly").append(list(fake_result_lines(run))[4])  # taken up again, after a table was written
    os.utime(tmp_path / RESULTS_FILE, ns=(0, 0))
    assert len(load_results(tmp_path)[0]) == 5


@pytest.fixture
def begun(tmp_path):
    """A folder of suite `smoke`, two episodes into its flights."""
    runner = Runner(load_suite("smoke"), tmp_path / "begun", clock=time.perf_counter, on_progress=print)
    runner.write_config(collect_provenance())
    for unit in build_units(runner.suite, "fly")[:2]:
        runner.log("fly").append(next(iter(fake_result_lines(unit))))
    return runner


def test_a_command_to_go_on_is_the_whole_one(begun, capsys):
    (begun.out / "fly.jsonl").unlink()
    assert run_command_line(["report", str(begun.out)]) == 5
    assert f"Go on with it: dualbrain evaluate --suite smoke --out {begun.out}" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [b"{", b"[]", b"\xff"])
def test_a_configuration_that_cannot_be_read_is_told_with_its_file(begun, capsys, damage):
    out = begun.out
    (out / "config.json").write_bytes(damage)
    for asked in (["report", out], ["evaluate", "--out", out, "--jobs", "1"], ["evaluate", "--dry-run", "--out", out]):
        assert run_command_line(list(map(str, asked))) == 5
        said = capsys.readouterr().err
        assert "configuration of the results" in said
        assert f"Bring back a copy, or name another --out. {out / 'config.json'}" in said
        assert "Traceback" not in said
    write_results(begun.rows(), {"suite": msgspec.to_builtins(begun.suite), "origin": {}}, out / RESULTS_FILE)
    os.utime(out / RESULTS_FILE, ns=(0, 0))  # taken up again after it was written
    assert run_command_line(["report", str(out)]) == 0
    assert "left out: What was flown since results.parquet" in capsys.readouterr().err


@pytest.mark.parametrize("lost", ["wall_s", "key"])
def test_a_line_that_lacks_something_is_told_and_the_rest_reported(begun, capsys, lost):
    path = begun.out / "fly.jsonl"
    first, second = map(msgspec.json.decode, path.read_bytes().splitlines())
    del second[lost]
    path.write_bytes(msgspec.json.encode(first) + b"\n" + msgspec.json.encode(second) + b"\n")
    assert run_command_line(["report", str(begun.out)]) == 0
    assert f"left out: Line 2 of fly.jsonl (Object missing required field `{lost}`)" in capsys.readouterr().err
    page = (begun.out / "page" / "report.md").read_text()
    assert "Line 2 of fly.jsonl" in page.partition("## What was not measured")[2]
    assert "1 episodes" in page
    for more in ((), ("--dry-run",)):
        assert run_command_line(["evaluate", "--suite", "smoke", "--jobs", "1", "--out", str(begun.out), *more]) == 5
        said = capsys.readouterr().err
        assert "line 2 of fly.jsonl" in said
        assert f"Delete it (where memory grows, all lines of its run): what it told is flown again. {path}" in said


def test_a_line_of_questions_that_lacks_something_is_told_too(begun, capsys):
    begun.journal("plan").append({"key": "B3 #0", "asked": 1})
    assert run_command_line(["evaluate", "--suite", "smoke", "--dry-run", "--out", str(begun.out)]) == 5
    assert "line 1 of plan.jsonl" in capsys.readouterr().err


def test_a_damaged_answer_is_left_out_of_a_report_and_asked_for_again(begun, capsys):
    plans = AnswerCache(begun.out / "plans")
    for words in ("put the cube down", "pick the cube up"):
        plans.put(
            "it",
            plan_request(instruction=words),
            Proposal(text="{}", finish_reason=STOP, planner="it", constrained_by="", timings={"total": 1.0}),
        )
    torn = next(iter((begun.out / "plans").glob("*.json")))
    torn.write_bytes(torn.read_bytes()[:20])
    assert run_command_line(["report", str(begun.out)]) == 0
    assert f"left out: The answer in plans/{torn.name}, which is damaged" in capsys.readouterr().err
    assert len(plans.read_all()) == 1
    known = [plans.get("it", plan_request(instruction=words)) for words in ("put the cube down", "pick the cube up")]
    assert known.count(None) == 1


def test_a_report_is_dated_by_its_last_flight(tmp_path):
    for name, day in (("results.parquet", 20_000), ("fly.jsonl", 10_000)):
        (tmp_path / name).write_text("")
        os.utime(tmp_path / name, (86_400 * day, 86_400 * day))
    assert last_run_date(tmp_path, {"flown": "2001-01-01"}) == "1997-05-19"
    (tmp_path / "fly.jsonl").unlink()
    assert last_run_date(tmp_path, {"flown": "2001-01-01"}) == "2001-01-01"
    assert last_run_date(tmp_path, {}) == "2024-10-04"


def test_a_suite_that_no_options_lead_to_came_from_a_file(tmp_path):
    ours = load_suite("smoke")
    for other in (msgspec.structs.replace(ours, name="mine"), msgspec.structs.replace(ours, shots=ours.shots + 1)):
        assert "--suite FILE.toml" in reproduction_command(other, tmp_path / "there")


def test_a_report_says_by_which_command_it_comes_again(tmp_path):
    asked = ("paper", "B1,M", "200", "panda", "base=transformers:base-135m")
    for told in (asked, ("paper", "", "0", "", ""), ("attacks", "", "0", "base", "")):
        flown = override_suite(told[0], told[1], int(told[2]), told[3], told[4] or "adapted=adapter:x")
        command = reproduction_command(flown, tmp_path / "there").split()
        assert command[:2] == ["dualbrain", "evaluate"]
        said = dict(zip(command[2::2], command[3::2], strict=True))
        assert said.pop("--out") == "there"
        again = [said.get(f"--{name}", "") for name in ("suite", "methods", "episodes", "robots", "planner")]
        assert override_suite(again[0], again[1], int(again[2] or 0), again[3], again[4]) == flown


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


def test_results_are_read_as_they_were_written(tmp_path):
    rows = [
        episode_row(),
        episode_row("B1", Delta=None, frequency=None, violations=(COLLISION,), trace_h=[], trace_t=[], trace_delta=[]),
        episode_row("M", answers=[["{", "length"], ["{}", "stop"]], instruction='ä "quoted" | line\n'),
    ]
    write_results(rows, {"suite": {"name": "x"}}, tmp_path / "results.parquet")
    assert read_results(tmp_path / "results.parquet") == (rows, {"suite": {"name": "x"}})


def test_a_file_that_is_no_parquet_is_rejected(tmp_path):
    (tmp_path / "results.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(ConfigurationError, match="no complete Parquet file"):
        read_results(tmp_path / "results.parquet")
