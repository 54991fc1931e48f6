"""Words for the operator: every check has words, and the supervisor's decision is before all else."""

from dataclasses import replace

import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD, ClearPolicy
from dualbrain.skills.registry import skill_modules
from dualbrain.visualization.live.operator.operator_status import (
    GIVING_WAY_TIME_S,
    FilterLimit,
    OperatorState,
    Situation,
    StatusTracker,
    describe_situation,
)
from dualbrain.visualization.live.operator_buttons import OPERATOR_BUTTONS

STRONG_CHECKS = [check for check in (*CHECKS, RESET_HELD) if check.action >= SafetyAction.HOVER]
MOVING = Situation(in_contract=True, phase="carry", delta=0.02, speed_share=0.4)
NEAR_PERSON = FilterLimit(part="hand", other="forearm", clearance=0.012, is_person=True)
NEAR_BOX = FilterLimit(part="hand", other="grey carton", clearance=0.004)


@pytest.mark.parametrize("check", STRONG_CHECKS, ids=lambda check: check.name)
def test_every_check_has_its_state_reason_and_next_action(check):
    now = replace(MOVING, action=check.action.name, check=check.name, limit=NEAR_PERSON)
    status = describe_situation(now)
    expected = {
        SafetyAction.HOVER: OperatorState.HOLDING,
        SafetyAction.HOLD: OperatorState.HOLDING,
        SafetyAction.CONTROLLED_STOP: OperatorState.STOPPED,
    }
    assert status.state is expected.get(check.action, OperatorState.EMERGENCY_STOP)
    assert check.description[1:] in status.reason
    assert status.next_action
    assert len(status.steps) == (2 if check.clears is ClearPolicy.ON_TWO_STEP_RESET else 0)


def test_the_steps_and_next_actions_name_buttons_that_exist():
    labels = {label for _, label in OPERATOR_BUTTONS}
    for check in STRONG_CHECKS:
        status = describe_situation(Situation(action=check.action.name, check=check.name))
        for text in (status.next_action, *status.steps):
            assert {part.partition("”")[0] for part in text.split("“")[1:]} <= labels | {"operator"}


def test_a_person_who_limits_the_motion_is_named_with_distance_and_slowdown():
    status = describe_situation(replace(MOVING, limit=NEAR_PERSON))
    assert status.state is OperatorState.GIVING_WAY
    assert "12 mm" in status.reason
    assert "40 %" in status.reason


def test_an_object_that_limits_the_motion_is_a_reason_but_no_other_state():
    status = describe_situation(replace(MOVING, limit=NEAR_BOX))
    assert status.state is OperatorState.MOVING
    assert "4 mm" in status.reason
    assert "grey carton" in status.reason


def test_a_binding_row_without_a_change_of_the_control_is_no_reason():
    assert describe_situation(replace(MOVING, limit=NEAR_PERSON, delta=0.0)).state is OperatorState.MOVING


def test_every_phase_that_permits_contact_has_a_sentence():
    model = load_robot("panda")
    permits = [one for module in skill_modules(model).values() for one in module.spec(model).permits]
    for permit in permits:
        assert f"step “{permit.phase}”" not in describe_situation(replace(MOVING, phase=permit.phase)).reason


@pytest.mark.parametrize("phase", ["wait", "yield"])
def test_waiting_for_a_person_is_giving_way(phase):
    assert describe_situation(replace(MOVING, phase=phase, delta=0.0)).state is OperatorState.GIVING_WAY


@pytest.mark.parametrize("status", ["STOPPED", "FAULT"])
def test_a_filter_that_brakes_is_a_stop(status):
    assert describe_situation(replace(MOVING, filter_status=status)).state is OperatorState.STOPPED


def test_a_robot_without_a_contract_holds_and_a_finished_run_has_stopped():
    assert describe_situation(Situation(phase="planning")).state is OperatorState.HOLDING
    ended = describe_situation(Situation(result="succeeded. The cube is in the bowl."))
    assert ended.state is OperatorState.STOPPED
    assert "The cube is in the bowl" in ended.reason


def test_an_emergency_stop_is_shown_even_after_the_end_of_the_run():
    now = Situation(result="emergency", action="ESTOP", check="estop")
    status = describe_situation(now)
    assert status.state is OperatorState.EMERGENCY_STOP
    assert status.steps == (), "no gatekeeper is left that could be reset"


def test_giving_way_stays_for_a_moment_but_never_hides_a_stop():
    tracker, way = StatusTracker(), replace(MOVING, limit=NEAR_PERSON, t=10.0)
    assert tracker.update(way).state is OperatorState.GIVING_WAY
    soon = replace(MOVING, delta=0.0, t=10.0 + 0.5 * GIVING_WAY_TIME_S)
    assert tracker.update(soon).state is OperatorState.GIVING_WAY
    assert tracker.update(replace(soon, action="ESTOP", check="estop")).state is OperatorState.EMERGENCY_STOP
    assert tracker.update(replace(soon, t=10.1 + GIVING_WAY_TIME_S)).state is OperatorState.MOVING
