"""A simulated run that a busy machine stops is tried again, by the check that ended its contract."""

import pytest

from dualbrain.control.recording.trace import Event
from dualbrain.runtime.planning.busy_machine import BUSY_MACHINE_CHECKS, ContractEnding
from dualbrain.runtime.session import RunObserver
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from tests.stories.story_session import hold_contract, run_config, run_session

PULSE_PERIOD_S, PULSE_S = 1.5, 0.1


def order(check):
    return Event(1.0, "order", f"CONTROLLED_STOP: {check}", {"action": "CONTROLLED_STOP", "check": check})


def test_the_checks_exist_and_end_a_contract():
    ending = {check.name for check in CHECKS if check.contract_outcome}
    assert set(BUSY_MACHINE_CHECKS) <= ending
    assert not {"estop", "abort", "unexpected_contact", "interrupted", "tracking_off"} & set(BUSY_MACHINE_CHECKS)


@pytest.mark.parametrize("name", ["tick_lost", "unexpected_contact"])
def test_the_first_check_that_ends_the_contract_counts(name):
    ending = ContractEnding()
    for event in (order("scene_old"), order(name), order("loop_behind"), Event(1.0, "phase", "tick_lost", {})):
        ending.on_event(event)
    assert (ending.busy_machine() is not None) is (name == "tick_lost")
    ending.on_event(Event(2.0, "action", "hold", {"index": 0}))
    assert ending.busy_machine() is None


def stops_of(tmp_path, monkeypatch, condition, *, seconds, pulses, **changes):
    """Outcomes of the tries of a contract of `seconds` while `condition` holds in the first `pulses` pulses."""

    def injected(_controller, _now, stamp):
        number, rest = divmod(stamp, PULSE_PERIOD_S)
        return condition if number < pulses and 0.3 < rest < 0.3 + PULSE_S else 0

    monkeypatch.setattr(SafetyController, "_loop_delay_conditions", injected)
    events: list[Event] = []
    config = run_config(tmp_path, **changes)
    story = run_session(config, hold_contract(seconds), observer=RunObserver(on_event=events.append))
    again = [event.text for event in events if event.text.startswith("planning again")]
    return [one.outcome.kind for one in (*story.result.earlier_episodes, story.episode)], again


def test_a_stop_by_a_busy_machine_is_tried_again_with_its_reason(tmp_path, monkeypatch):
    limits = {"seconds": 0.5, "pulses": 1, "tries": 3}
    kinds, again = stops_of(tmp_path, monkeypatch, Condition.LOOP_BEHIND, retry_when_busy=True, **limits)
    assert kinds == ["stopped", "succeeded"]
    (line,) = again
    assert "try 2 of 3" in line
    assert "busy" in line
    assert "falls behind" in line


@pytest.mark.parametrize(
    ("condition", "retry_when_busy"), [(Condition.LOOP_BEHIND, False), (Condition.CONTROL_BAD, True)], ids=str
)
def test_no_other_stop_is_tried_again(tmp_path, monkeypatch, condition, retry_when_busy):
    limits = {"seconds": 0.5, "pulses": 1, "tries": 3}
    assert stops_of(tmp_path, monkeypatch, condition, retry_when_busy=retry_when_busy, **limits) == (["stopped"], [])


def test_a_machine_that_stays_busy_ends_the_tries_at_their_limit(tmp_path, monkeypatch):
    limits = {"seconds": 20.0, "pulses": 99, "tries": 3}
    kinds, again = stops_of(tmp_path, monkeypatch, Condition.LOOP_BEHIND, retry_when_busy=True, **limits)
    assert kinds == ["stopped"] * 3
    assert len(again) == 2
