"""The numbered examples run as a newcomer runs them, in seconds, and say what they show."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))


def told(name, patience=120):
    """What the example prints."""
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    run = subprocess.run(
        [sys.executable, "-W", "error", str(ROOT / "examples" / f"{name}.py")],
        capture_output=True,
        text=True,
        encoding="utf-8",
        env=environment,
        timeout=patience,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert not run.stderr
    return run.stdout


def test_one_contract_passes_the_gate_and_each_stage_stops_one():
    lines = told("01_gate_a_contract").splitlines()
    verdicts = [line.split(": ")[1].split(",")[0] for line in lines[2:]]
    assert verdicts == ["accepted", *(f"rejected at {stage}" for stage in ("syntax", "authorization", "envelope"))]


def test_the_filter_lets_the_arm_through_nowhere():
    text = told("02_filter_five_lines")
    gaps = [float(line.split("h_min")[1].split("mm")[0]) for line in text.splitlines() if "h_min" in line]
    assert len(gaps) > 8
    assert min(gaps) >= 0.0
    assert "'table'" in text
    assert "'post'" in text


def test_a_given_contract_becomes_motion():
    text = told("03_run_a_contract")
    assert "succeeded: red_cube is at blue_bowl" in text
    assert "simulator truth: success, 0 violations" in text


def test_the_filter_alone_keeps_a_careless_controller_from_crate_and_ball():
    lines = told("04_filter_alone").splitlines()
    gaps = [float(line.split(" h ")[1].split("mm")[0]) for line in lines]
    assert min(gaps) >= 0.0
    assert all("go on" in line for line in lines)
    assert any("'crate'" in line for line in lines)
    assert any("'ball'" in line for line in lines)


def test_cruise_control_keeps_its_headway_only_with_a_barrier_that_knows_the_brakes():
    free, plain, braking = told("05_cruise_control").splitlines()
    least = [float(line.split("1.8 v")[1].split("m")[0]) for line in (free, plain, braking)]
    assert least[0] < -100.0
    assert least[1] < -1.0
    assert "relaxed" in plain
    assert least[2] >= 0.0


def test_a_unicycle_bends_round_the_disc_in_both_ways():
    free, force, point = told("06_unicycle").splitlines()
    gaps = [float(line.split("gap")[1].split("m")[0]) for line in (free, force, point)]
    assert gaps[0] < 0.0 <= min(gaps[1:])
    assert all(float(line.split("came")[1].split("m")[0]) > 8.0 for line in (force, point))
    assert "relative degree 2" in force
    assert "relative degree 1" in point


def test_a_double_integrator_follows_the_closed_form():
    first, *seconds, last = told("07_double_integrator").splitlines()
    assert first == "relative degree 2"
    assert float(last.split()[-2]) < 1e-9
    assert len(seconds) == 5
    for line in seconds:
        p, exact = (float(line.split(word)[1].split("m")[0]) for word in (" p ", "exact"))
        assert abs(p - exact) < 2e-3
        assert p > 0.0


def test_a_pendulum_leans_no_further_than_it_may():
    first, filtered, free = told("08_inverted_pendulum").splitlines()
    assert first.startswith("relative degrees (2, 2)")
    assert 0.25 < float(filtered.split("leans")[1].split("rad")[0]) <= 0.3
    assert free == "without: falls"


def test_what_was_observed_is_prevented_when_the_filter_is_switched_on():
    text = told("09_observe_mode")
    assert "2 episodes" in text
    assert text.count("hand vs 'post'") == 2
    assert float(text.split("Least h")[1].split("mm")[0]) < 0.0
    assert float(text.split("nothing nearer than")[1].split("mm")[0]) > 0.0


def test_a_policy_behind_the_filter_stays_off_the_shelf():
    watched, filtered = told("10_gym_policy").splitlines()
    assert float(watched.split("least h")[1].split("mm")[0]) < -10.0
    assert float(filtered.split("least h")[1].split("mm")[0]) >= 0.0
    assert "'shelf'" in filtered


def test_a_depth_image_keeps_the_arm_from_what_it_shows_and_silence_stops_it():
    lines = told("11_depth_image").splitlines()
    assert int(lines[0].split()[0]) >= 4
    assert lines[1].startswith("refused: frame 'lense'")
    assert "old, at most 0.2 s" in lines[2]
    assert "'camera/cluster" in lines[3] + lines[4]
    assert "seen too long ago" in lines[5]
    assert float(lines[6].split("than")[1].split("mm")[0]) >= 0.0


def test_a_stranger_brings_a_robot_in_four_commands_and_two_minutes():
    text = told("12_your_robot", patience=600)
    assert text.count("$ dualbrain") == 4
    assert "asked for: --acceleration, --period, --tool-speed" in text
    assert "100.00% of every part's surface" in text
    assert "Look at http://127.0.0.1:" in text
    assert float(text.split("least h")[1].split("mm")[0]) >= 0.0
    assert "skills: move_to" in text
    busy = text.split("four commands, ")[1].split(" s, ")[1].split(" s of one processor")[0]
    assert float(busy) < 60.0  # two minutes are meant of a machine with nothing else to do
    assert "body.json" in text


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text("utf-8").splitlines()) < 100
    assert f'told("{path.stem}"' in Path(__file__).read_text("utf-8"), "an example without a test"
