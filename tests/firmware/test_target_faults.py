"""Faults in a run whose filter and supervisor are on an emulated board: the board decides as the host."""

import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.evaluation.fault_injection.faults import Fault
from dualbrain.evaluation.fault_injection.trial import run_fault_trial
from dualbrain.safety.supervisor.actions import SafetyAction


@pytest.mark.parametrize(
    ("source", "kind", "robot", "scene", "board"),
    [
        ("state", "garbage", "panda", "bare:0", "an386"),
        ("scene", "stuck", "panda", "forearm:0", "an500"),
        ("drive", "off", "base", "boxes:0", "an505"),
    ],
)
def test_the_board_decides_as_the_host_with_equal_bits(source, kind, robot, scene, board):
    report = run_fault_trial(Fault(source, kind, "closing"), robot=robot, scene=scene, target=board)
    assert (report.safe, report.as_declared) == (True, True), report
    target = report.target
    assert target is not None
    assert (target.board, target.lost, target.differences) == (board, "", 0)
    assert target.steps > 100
    assert target.reached == report.reached
    assert target.drive_off == (SafetyAction[report.reached] >= SafetyAction.CONTROLLED_STOP)


@pytest.mark.parametrize(("kind", "seed"), [("wrong", 0), ("intermittent", 1)])
def test_a_link_that_fails_ends_the_motion(kind, seed):
    report = run_fault_trial(Fault("target", kind, "closing", seed), scene="bare:0", target="an386")
    assert (report.safe, report.as_declared, report.reached) == (True, True, "ESTOP"), report
    assert report.struck is not None
    assert report.target is not None
    assert "did not answer" in report.target.lost


def test_sources_that_need_a_target_or_exclude_one():
    with pytest.raises(ConfigurationError, match="Name a board"):
        run_fault_trial(Fault("target", "off", "closing"))
    with pytest.raises(ConfigurationError, match="Leave out the target"):
        run_fault_trial(Fault("planner", "off", "closing"), target="an386")
    with pytest.raises(UnknownNameError, match="an9"):
        run_fault_trial(Fault("state", "off", "closing"), target="an9")
