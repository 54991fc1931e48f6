"""The numbered examples run within seconds, print no warnings, and show the documented results."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted([*(ROOT / "examples").glob("[0-9]*.py"), *(ROOT / "examples/control_affine").glob("*.py")])


def run_example(name, timeout=120):
    """The output of the example called `name`."""
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    run = subprocess.run(
        [sys.executable, "-W", "error", str(ROOT / "examples" / f"{name}.py")],
        capture_output=True,
        text=True,
        encoding="utf-8",
        env=environment,
        timeout=timeout,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert not run.stderr
    return run.stdout


def test_one_contract_passes_the_gate_and_each_stage_rejects_one():
    lines = run_example("01_gate_a_contract").splitlines()
    verdicts = [line.split(": ")[1].split(",")[0] for line in lines[2:]]
    assert verdicts == ["accepted", *(f"rejected at {stage}" for stage in ("syntax", "authorization", "envelope"))]


def test_the_filter_prevents_every_contact():
    text = run_example("02_filter_five_lines")
    gaps = [float(line.split("h_min")[1].split("mm")[0]) for line in text.splitlines() if "h_min" in line]
    assert len(gaps) > 8
    assert min(gaps) >= 0.0
    assert "'table'" in text
    assert "'post'" in text


def test_a_given_contract_becomes_motion():
    text = run_example("03_run_a_contract")
    assert "succeeded: red_cube is at blue_bowl" in text
    assert "simulator ground truth: success, 0 violations" in text


def test_the_filter_alone_keeps_a_controller_away_from_crate_and_ball():
    lines = run_example("04_filter_alone").splitlines()
    gaps = [float(line.split(" h ")[1].split("mm")[0]) for line in lines]
    assert min(gaps) >= 0.0
    assert all("continue" in line for line in lines)
    assert any("'crate'" in line for line in lines)
    assert any("'ball'" in line for line in lines)


def test_cruise_control_keeps_its_headway_only_with_a_barrier_for_the_braking_distance():
    free, plain, braking = run_example("control_affine/cruise_control").splitlines()
    least = [float(line.split("1.8 v")[1].split("m")[0]) for line in (free, plain, braking)]
    assert least[0] < -100.0
    assert least[1] < -1.0
    assert "relaxed" in plain
    assert least[2] >= 0.0


def test_a_unicycle_passes_the_disc_with_both_barriers():
    free, force, point = run_example("control_affine/unicycle").splitlines()
    gaps = [float(line.split("gap")[1].split("m")[0]) for line in (free, force, point)]
    assert gaps[0] < 0.0 <= min(gaps[1:])
    assert all(float(line.split("distance")[1].split("m")[0]) > 8.0 for line in (force, point))
    assert "relative degree 2" in force
    assert "relative degree 1" in point


def test_a_double_integrator_follows_the_closed_form():
    first, *seconds, last = run_example("control_affine/double_integrator").splitlines()
    assert first == "relative degree 2"
    assert float(last.split()[-2]) < 1e-9
    assert len(seconds) == 5
    for line in seconds:
        p, exact = (float(line.split(word)[1].split("m")[0]) for word in (" p ", "exact"))
        assert abs(p - exact) < 2e-3
        assert p > 0.0


def test_a_pendulum_stays_within_its_maximum_angle():
    first, filtered, free = run_example("control_affine/inverted_pendulum").splitlines()
    assert first.startswith("relative degrees (2, 2)")
    assert 0.25 < float(filtered.split("angle")[1].split("rad")[0]) <= 0.3
    assert free == "without the filter: falls"


def test_the_active_filter_prevents_the_violations_seen_in_shadow_mode():
    text = run_example("05_shadow_mode")
    assert "2 intervals" in text
    assert text.count("vs 'post', ") == 2
    assert float(text.split("Smallest h:")[1].split("mm")[0]) < 0.0
    assert float(text.split("minimum clearance")[1].split("mm")[0]) > 0.0


def test_a_filtered_policy_avoids_the_shelf():
    observed, filtered = run_example("06_gym_policy").splitlines()
    assert float(observed.split("minimum h")[1].split("mm")[0]) < -10.0
    assert float(filtered.split("minimum h")[1].split("mm")[0]) >= 0.0
    assert "'shelf'" in filtered


def test_the_arm_avoids_the_objects_in_a_depth_image_and_stops_without_new_images():
    lines = run_example("07_depth_image").splitlines()
    assert int(lines[0].split()[0]) >= 4
    assert lines[1].startswith("refused: frame 'lense'")
    assert "exceeds the limit of 0.2 s" in lines[2]
    assert "'camera/cluster" in lines[3] + lines[4]
    assert "seen too long ago" in lines[5]
    assert float(lines[6].split("clearance")[1].split("mm")[0]) >= 0.0


def test_a_robot_is_imported_with_four_commands_in_two_minutes():
    text = run_example("08_your_robot", timeout=600)
    assert text.count("$ dualbrain") == 4
    assert "missing: --acceleration, --period, --tool-speed" in text
    assert "100.00% of the surface of every link" in text
    assert "view: http://127.0.0.1:" in text
    assert float(text.split("minimum h")[1].split("mm")[0]) >= 0.0
    assert "skills: move_to" in text
    processor_time = text.split("four commands, ")[1].split(" s, ")[1].split(" s of processor time")[0]
    assert float(processor_time) < 60.0  # two minutes by the clock on an idle machine
    assert "body.json" in text


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text("utf-8").splitlines()) < 100
    name = path.relative_to(ROOT / "examples").with_suffix("")
    assert f'run_example("{name}"' in Path(__file__).read_text("utf-8"), "an example without a test"
