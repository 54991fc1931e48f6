"""Profiles of grips from a trace: forces, openings, sudden closing, and the end of the grip."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.recording.grip_profile import grip_profiles
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.interface import RobotState, home_state
from dualbrain.robots.loader import load_robot
from dualbrain.skills.arm.load_monitor import press_on_object

PERIOD, N = 0.01, 7
GRASP, PLACE = Action("grasp", {"object": "red_cube"}), Action("place", {"destination": "blue_bowl"})
RESULT = SimpleNamespace(
    u=np.zeros(N),
    status=0,
    delta=0.0,
    delta_rows=0.0,
    delta_box=0.0,
    h_min=1.0,
    certified=True,
    iterations=1,
    n_rows=0,
    delta_supervisor=0.0,
)


def trace_of(*parts):
    """A trace of `parts` (action, opening, force, ticks)."""
    trace, t = Trace(N), 0.0
    for action, opening, force, ticks in parts:
        for _ in range(ticks):
            state = RobotState(
                stamp=t, sequence=0, q=np.zeros(N), v=np.zeros(N), opening=opening, finger_forces=(force, force)
            )
            trace.append(t, state, np.zeros(N), RESULT, action=action, phase="p")
            t += PERIOD
    return trace


def profiles(trace, *actions, held=None, first=0):
    return grip_profiles(trace, first, Contract("c-0001", Context("panda", "x" * 8), actions), held)


def test_a_grip_that_a_place_ends():
    opened = (1, 0.04, 0.0, 20), (-1, 0.04, 0.0, 9)
    trace = trace_of((0, 0.04, 0.0, 20), (0, 0.02, 20.0, 40), (1, 0.02, 18.0, 40), *opened)
    (one,) = profiles(trace, GRASP, PLACE)
    assert (one.object_name, one.max_force, one.first_opening, one.min_opening) == ("red_cube", 20.0, 0.02, 0.02)
    assert one.released
    assert not one.holds_at_end
    assert (one.end_force, one.end_opening, one.fastest_closing) == (0.0, 0.04, 0.0)


def test_a_grip_that_lasts():
    (one,) = profiles(trace_of((0, 0.04, 0.0, 20), (0, 0.02, 20.0, 60), (-1, 0.02, 20.0, 9)), GRASP)
    assert one.holds_at_end
    assert not one.released


@pytest.mark.parametrize("opening", [0.0, 0.0004, 0.0005, 0.0015])
def test_a_thin_object_is_held_as_the_skills_decide(opening):
    trace = trace_of((0, 0.04, 0.0, 20), (0, opening, 10.0, 60))
    (one,) = profiles(trace, GRASP)
    state = replace(home_state(load_robot("panda")), opening=opening, finger_forces=(10.0, 10.0))
    assert one.holds_at_end == press_on_object(state)


def test_an_object_that_is_lost():
    (one,) = profiles(trace_of((0, 0.02, 20.0, 60), (0, 0.0, 0.0, 20)), GRASP)
    assert not one.holds_at_end
    assert not one.released


HOLD, RELEASE = Action("hold", {"duration": 1.0}), Action("release", {"speed": 0.1})


def test_an_object_in_the_hand_at_the_beginning_has_the_first_profile():
    """Its grip ends with the first skill that opens the hand; the ticks before the contract do not count."""
    carried = (-1, 0.02, 60.0, 30), (-1, 0.02, 20.0, 9), (0, 0.02, 20.0, 40)
    trace = trace_of(*carried, (1, 0.02, 15.0, 9), (1, 0.04, 0.0, 9), (2, 0.018, 9.0, 30))
    one, two = profiles(trace, HOLD, PLACE, Action("grasp", {"object": "green_tin"}), held="red_cube", first=30)
    assert (one.object_name, one.max_force, one.first_opening, one.released) == ("red_cube", 20.0, 0.02, True)
    assert not one.holds_at_end
    assert (two.object_name, two.max_force, two.holds_at_end) == ("green_tin", 9.0, True)
    (kept,) = profiles(trace_of(*carried), HOLD, RELEASE, held="red_cube")
    assert (kept.holds_at_end, kept.released) == (True, False)
    (lost,) = profiles(trace_of(*carried, (0, 0.0, 0.0, 9)), HOLD, held="red_cube")
    assert (lost.holds_at_end, lost.released) == (False, False)


@pytest.mark.parametrize(("step", "ticks", "sudden"), [(0.005, 0, True), (0.005, 200, False)])
def test_a_collapse_is_sudden_and_a_creep_is_not(step, ticks, sudden):
    """The same loss of gap within one tick, or over two seconds."""
    creep = [(0, 0.02 - step * (k + 1) / ticks, 20.0, 1) for k in range(ticks)] or [(0, 0.02 - step, 20.0, 1)]
    (one,) = profiles(trace_of((0, 0.02, 20.0, 60), *creep, (0, 0.02 - step, 20.0, 20)), GRASP)
    assert (one.fastest_closing > 0.003) == sudden


def test_without_contact_there_is_no_profile():
    assert profiles(trace_of((0, 0.0, 0.0, 50)), GRASP) == ()
    assert profiles(trace_of((0, 0.02, 20.0, 50)), PLACE) == ()
    assert grip_profiles(Trace(N), 0, Contract("c-0001", Context("panda", "x" * 8), (GRASP,))) == ()


VALUES = st.sampled_from([0.0, 0.02, 20.0, -1.0, 1e300, np.nan, np.inf, -np.inf])


@given(st.lists(st.tuples(st.integers(-1, 1), VALUES, VALUES, VALUES), min_size=1, max_size=60))
def test_failing_sensors_and_clocks_give_finite_profiles(ticks):
    trace = Trace(N)
    for action, t, opening, force in ticks:
        state = RobotState(
            stamp=0.0, sequence=0, q=np.zeros(N), v=np.zeros(N), opening=opening, finger_forces=(force, 20.0)
        )
        trace.append(t, state, np.zeros(N), RESULT, action=action, phase="p")
    for one in profiles(trace, GRASP, PLACE):
        numbers = (
            one.max_force,
            one.first_opening,
            one.min_opening,
            one.fastest_closing,
            one.end_force,
            one.end_opening,
        )
        assert np.isfinite(numbers).all()


def test_a_grip_that_is_not_measured_at_the_end_does_not_count_as_held():
    (one,) = profiles(trace_of((0, 0.04, 0.0, 20), (0, 0.02, 20.0, 60), (0, np.nan, np.nan, 1)), GRASP)
    assert (one.max_force, one.end_opening, one.holds_at_end) == (20.0, 0.02, False)


def test_a_clock_without_numbers_does_not_hide_a_grip():
    trace, state = trace_of((0, 0.04, 0.0, 20)), home_state(load_robot("panda"))
    for _ in range(60):
        pressing = replace(state, opening=0.02, finger_forces=(20.0, 20.0))
        trace.append(np.nan, pressing, np.zeros(N), RESULT, action=0, phase="p")
    (one,) = profiles(trace, GRASP)
    assert (one.max_force, one.holds_at_end) == (20.0, True)
