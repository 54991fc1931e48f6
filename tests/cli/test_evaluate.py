"""`dualbrain evaluate`: estimates, rejected suites, missing dependencies, interruption."""

import time

import msgspec
import pytest

from dualbrain.cli.evaluation import evaluate
from dualbrain.cli.evaluation.estimate import (
    DEFAULT_EPISODE_S,
    DEFAULT_LARGE_MODEL_REQUEST_S,
    DEFAULT_SMALL_MODEL_REQUEST_S,
    default_request_time,
)
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.cli.main import run_command_line
from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.evaluation.protocol.suite import builtin_suites, load_suite
from dualbrain.evaluation.runner import probe as probe_module
from dualbrain.evaluation.runner.probe import ProbeTimes
from dualbrain.evaluation.runner.provenance import collect_provenance
from dualbrain.evaluation.runner.runner import STAGES, Runner, resolve_config
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.evaluation.runner.workload import compute_workload, distinct_units
from tests.evaluation.sample_rows import fake_result_lines


def test_the_help_names_every_built_in_suite():
    assert [name for name in builtin_suites() if name not in (evaluate.evaluate.__doc__ or "")] == []


def test_a_method_that_reuses_no_contracts_is_stored_as_in_older_results():
    methods = resolve_config(load_suite("reuse"), {}, {})["methods"]
    assert [name for name, settings in methods.items() if "reuse_contracts" in settings] == ["M-reuse"]


def test_a_dry_run_runs_nothing_and_estimates_the_duration(tmp_path, capsys, monkeypatch):
    command = ["evaluate", "--suite", "smoke", "--dry-run", "--json", "--episodes", "3", "--out", str(tmp_path / "x")]
    assert run_command_line([*command, "--methods", "B1,M"]) == 0
    estimate = msgspec.json.decode(capsys.readouterr().out)
    assert estimate["left"] == {"pilot": 0, "start": 1, "plan": 0, "fly": 6}
    assert estimate["basis"] == "measured now"
    assert 1.0 < estimate["episode_s"] < 60.0
    assert not (tmp_path / "x").exists()
    monkeypatch.setattr(probe_module, "probe", lambda *_: ProbeTimes(4.0, {"base-135m": 2.0}))
    assert run_command_line(["evaluate", "--methods", "B9", "--dry-run"]) == 5
    assert run_command_line(["evaluate", "--suite", "paper"]) == 5
    assert "--planner adapted=adapter:ID" in capsys.readouterr().err
    planners = "adapted=base-135m,base=template"
    assert (
        run_command_line(
            ["evaluate", "--suite", "paper", "--dry-run", "--planner", planners, "--out", str(tmp_path / "y")]
        )
        == 0
    )


def test_a_dry_run_leaves_out_methods_without_a_planner(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(probe_module, "probe", lambda *_: ProbeTimes(4.0, {"base-135m": 2.0}))
    command = ["evaluate", "--suite", "paper", "--dry-run", "--json", "--jobs", "2", "--out", str(tmp_path / "x")]
    assert run_command_line(command) == 0
    out, err = capsys.readouterr()
    assert "not included: P, Full, which need an adapted planner" in err
    estimate = msgspec.json.decode(out)
    assert estimate["left"] == {"pilot": 40, "start": 48, "plan": 800, "fly": 7 * 400}
    # B1, B2 and G share their episodes; every fifth episode of B3, B4, M and PE is repeated without filter
    assert estimate["hours"]["episodes"] == pytest.approx(4.0 * (40 + 48 + 400 + 4 * 480) / 2 / 3600)


def test_the_assumed_request_time_is_that_of_the_model_that_answers(tmp_path, capsys, monkeypatch):
    sources = PlannerSources(tmp_path, tmp_path)
    for small in ("base-135m", "adapter:starter-135m", "transformers:base-135m", "smollm2-135m-instruct"):
        assert default_request_time(small, sources) == DEFAULT_SMALL_MODEL_REQUEST_S
    for large in ("qwen2.5-coder-1.5b-instruct", "transformers:qwen2.5-coder-1.5b-instruct", "http://host/v1"):
        assert default_request_time(large, sources) == DEFAULT_LARGE_MODEL_REQUEST_S
    command = ["evaluate", "--suite", "paper", "--methods", "B3,P", "--dry-run", "--json", "--jobs", "1"]
    command += ["--planner", "base=template,prompted=template,adapted=base-135m", "--out", str(tmp_path / "x")]
    monkeypatch.setattr(probe_module, "probe", lambda *_: ProbeTimes())
    assert run_command_line(command) == 0
    one = msgspec.json.decode(capsys.readouterr().out)
    assert one["request_s"] == {"base-135m": DEFAULT_SMALL_MODEL_REQUEST_S}
    assert one["episode_s"] == DEFAULT_EPISODE_S
    command[command.index("--planner") + 1] = "base=qwen2.5-coder-1.5b-instruct,adapted=base-135m"
    assert run_command_line(command) == 0
    both = msgspec.json.decode(capsys.readouterr().out)
    assert both["request_s"] == {
        "qwen2.5-coder-1.5b-instruct": DEFAULT_LARGE_MODEL_REQUEST_S,
        "base-135m": DEFAULT_SMALL_MODEL_REQUEST_S,
    }
    suite = override_suite("paper", "B3", 0, "", "base=qwen2.5-coder-1.5b-instruct")
    units = [unit for stage in STAGES for unit in build_units(suite, stage)]
    more = compute_workload(suite, distinct_units(suite, units)).requests * DEFAULT_LARGE_MODEL_REQUEST_S / 3600.0
    assert both["hours"]["planning"] - one["hours"]["planning"] == pytest.approx(more)


def test_times_measured_in_the_folder_replace_the_assumed_ones_by_planner(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(probe_module, "probe", lambda *_: ProbeTimes())
    command = ["evaluate", "--suite", "paper", "--methods", "B3,P", "--dry-run", "--json", "--out", str(tmp_path)]
    command += ["--planner", "adapted=starter-135m"]
    runner = Runner(
        override_suite("paper", "B3,P", 0, "", "adapted=starter-135m"),
        tmp_path,
        clock=time.perf_counter,
        on_progress=print,
    )
    unit = next(unit for unit in build_units(runner.suite, "plan") if unit.method == "P")
    for order, (new, seconds) in enumerate([(1, 7.0), (0, 0.0), (1, 9.0)]):
        runner.log("plan").append({"key": unit.row_key(order), "asked": new, "planner_s": seconds})
    line = next(iter(fake_result_lines(build_units(runner.suite, "fly")[0])))
    runner.log("fly").append(line | {"wall_s": 11.0})
    assert run_command_line(command) == 0
    estimate = msgspec.json.decode(capsys.readouterr().out)
    assert estimate["request_s"] == {"base-135m": DEFAULT_SMALL_MODEL_REQUEST_S, "starter-135m": 8.0}
    assert (estimate["episode_s"], estimate["basis"]) == (11.0, "measured in these results")


def test_methods_with_a_single_run_cause_a_warning(tmp_path, capsys, monkeypatch):
    warning = "fewer than two runs of B1, B3: the report will contain intervals of rates only"
    monkeypatch.setattr(evaluate, "_run_stages", lambda *_: True)
    monkeypatch.setattr(probe_module, "probe", lambda *_: ProbeTimes(4.0, {}))
    for more in (("--dry-run",), ()):
        command = ["evaluate", "--methods", "B1,B3", "--planner", "template", "--out", str(tmp_path), *more]
        assert run_command_line([*command, "--suite", "smoke", "--episodes", "5"]) == 0
        assert warning in capsys.readouterr().err
    assert run_command_line(["evaluate", "--methods", "B1", "--suite", "scenes", "--dry-run"]) == 0
    assert "fewer than two runs" not in capsys.readouterr().err
    suite = load_suite("refusals")
    assert [suite.n_clusters(name) for name in ("B1", "P")] == [6 * 20, 3 * 20]
    assert load_suite("paper").n_clusters("B3") == 40


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--suite", "smoke", "--planner", "nosuch"), 5, "base-135m"),
        (("--suite", "smoke", "--planner", "foo=template"), 5, "adapted_no_kl"),
        (("--suite", "smoke", "--planner", "base="), 2, "ROLE=PLANNER"),
        (("--suite", "smoke", "--planner", "base=template,base=adversary"), 2, "each role once"),
        (("--suite", "smoke", "--planner", "http://host/v1?key=a#m"), 5, "role base: got 'http://host/v1#m"),
        (("--suite", "paper", "--planner", "adapted=adapter:deadbeef"), 5, "deadbeef"),
        (("--suite", "smoke", "--methods", "B1,B1,B3"), 5, "B1 twice"),
        (("--suite", "smoke", "--methods", "B1,"), 2, "--methods: got 'B1,'"),
        (("--suite", "smoke", "--robots", "panda,"), 2, "--robots: got 'panda,'"),
        (("--suite", "smoke", "--robots", "base"), 5, "clutter_grasp I: panda, "),
        (("--suite", "refusals", "--robots", "ur5e", "--planner", "adapted=base-135m"), 5, "hazardous: panda;"),
        (("--suite", "paper", "--methods", "B3-depth"), 5, "Leave out B3-depth"),
    ],
)
def test_an_invalid_suite_is_rejected_also_by_a_dry_run(tmp_path, capsys, monkeypatch, options, code, message):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    for arguments in (options, (*options, "--dry-run")):
        assert run_command_line(["evaluate", *arguments, "--out", str(tmp_path / "x")]) == code
        assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_a_dry_run_rejects_a_folder_that_cannot_be_resumed(tmp_path):
    command = ["evaluate", "--suite", "smoke", "--dry-run", "--out", str(tmp_path)]
    smoke = load_suite("smoke")
    Runner(smoke, tmp_path, clock=time.perf_counter, on_progress=print).write_config(collect_provenance())
    assert run_command_line(command) == 0
    assert run_command_line([*command, "--methods", "B1"]) == 5  # every method of the folder has to be named
    (tmp_path / "config.json").unlink()
    Runner(smoke, tmp_path, clock=time.perf_counter, on_progress=print).write_config(
        {**collect_provenance(), "code": "another"}
    )
    assert run_command_line(command) == 5


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        (("--suite", "smoke"), "minilm-l6-v2-int8"),
        (("--suite", "smoke", "--methods", "B1", "--planner", "qwen2.5-coder-1.5b-instruct"), "qwen2.5-coder-1.5b"),
        (("--suite", "smoke", "--methods", "B1", "--planner", "transformers:base-135m"), "smollm2-135m-instruct"),
        (("--suite", "smoke", "--methods", "P", "--planner", "adapted=adapter:aa"), "adapter"),
    ],
)
def test_missing_weights_are_reported_once_before_any_episode(tmp_path, capsys, monkeypatch, options, missing):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    assert run_command_line(["evaluate", *options, "--jobs", "1", "--out", str(tmp_path / "x")]) == 5
    message = capsys.readouterr().err
    assert missing in message
    assert len(message.splitlines()) == 1
    assert not (tmp_path / "x" / "config.json").exists()


def test_missing_rendering_is_reported_before_any_episode(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    command = ["evaluate", "--suite", "eyes", "--methods", "B3-depth", "--planner", "template"]
    assert run_command_line([*command, "--out", str(tmp_path / "x")]) == 5
    message = capsys.readouterr().err
    assert "cameras of B3-depth" in message
    assert "apt-get install" in message
    assert not (tmp_path / "x").exists()


def test_an_interruption_prints_how_to_resume(tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "_run_stages", interrupted)
    assert run_command_line(["evaluate", "--suite", "smoke", "--methods", "B1", "--out", str(tmp_path)]) == 130
    message = capsys.readouterr().err
    assert "the same command resumes the evaluation" in message
    assert "dualbrain: interrupted" in message


@pytest.mark.parametrize(("broken", "done"), [("plan", STAGES), ("pilot", ("pilot",)), ("", STAGES)])
def test_episodes_run_after_an_incomplete_plan_pass_but_not_without_epsilon(monkeypatch, broken, done):
    started = []
    monkeypatch.setattr(evaluate, "_run_stage", lambda runner, stage, *_: started.append(stage) or stage != broken)
    assert evaluate._run_stages(None, STAGES, None, 1) == (not broken)
    assert tuple(started) == done
