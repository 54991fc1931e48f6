"""Properties of the kernel that tools read from its sources; the long analyses run by `make analysis`."""

import shutil

import pytest

from tools.static_analysis import checks
from tools.static_analysis.loops import kernel_loops, loop_bound


def test_every_loop_of_the_kernel_has_a_bound():
    unbounded = [(loop.file, loop.line, loop.header) for loop in kernel_loops() if loop.bound is None]
    assert not unbounded, "write a counting loop, or add the bound to tools/static_analysis/loops.py"


def test_a_loop_without_a_counter_has_no_bound():
    assert loop_bound("int32_t k = 0; k < n; ++k") == "n"
    assert loop_bound("x > (dbk_real)0") is None
    assert loop_bound("int32_t k = 0; k < n; k = next[k]") is None


@pytest.mark.skipif(shutil.which("frama-c") is None, reason="the Debian package frama-c-base is not installed")
def test_the_output_of_a_step_is_proven_finite_and_within_the_limits(tmp_path):
    """For all bits of the computed control; an alarm is a possible run-time error."""
    found = checks.verify_output(tmp_path)
    assert found == {"alarms": 0, "kinds": {}, "assertions": {"valid": 1, "unknown": 0, "invalid": 0}}


@pytest.mark.skipif(shutil.which("frama-c") is None, reason="the Debian package frama-c-base is not installed")
def test_the_supervisor_has_no_run_time_error_for_any_time_condition_or_state(tmp_path):
    found = checks.analyse_supervisor(tmp_path)
    assert found == {"alarms": 0, "kinds": {}, "assertions": {"valid": 2, "unknown": 0, "invalid": 0}}
