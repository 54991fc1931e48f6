"""The control loop goes on while a planner thinks, for a fixed time or for as long as it takes."""

import threading
import time

import pytest

from dualbrain.runtime.planning_time import PlanningClock


class Standing:
    """A layer that only counts how long it stood."""

    def __init__(self, interrupted_after=float("inf")):
        self.stood, self._limit = 0.0, interrupted_after

    def hold(self, duration, phase):
        assert phase == "planning"
        self.stood += duration
        time.sleep(0.001)

    def interrupted(self):
        return self.stood >= self._limit


def test_in_lockstep_the_arm_stands_for_the_fixed_time_however_long_the_answer_takes():
    for pause in (0.0, 0.05):
        layer = Standing()
        answer = PlanningClock(time.monotonic, planning_time=2.0).wait_for(
            layer, lambda pause=pause: time.sleep(pause) or "yes"
        )
        assert (answer, layer.stood) == ("yes", 2.0)


def test_measured_the_arm_stands_as_long_as_the_answer_takes():
    layer, ready = Standing(), threading.Event()

    def ask():
        assert ready.wait(10.0)
        return "yes"

    def stood(duration, phase):
        Standing.hold(layer, duration, phase)
        if layer.stood > 0.5:
            ready.set()

    layer.hold = stood
    assert PlanningClock(time.monotonic, measured=True).wait_for(layer, ask) == "yes"
    assert layer.stood > 0.5


def test_the_planner_is_asked_on_another_thread():
    asked = []
    PlanningClock(time.monotonic, planning_time=0.0).wait_for(
        Standing(), lambda: asked.append(threading.current_thread())
    )
    assert asked[0] is not threading.current_thread()
    assert asked[0].daemon


@pytest.mark.parametrize("measured", [False, True])
def test_an_interruption_does_not_wait_for_the_answer(measured):
    never = threading.Event()
    layer = Standing(interrupted_after=0.0)
    assert PlanningClock(time.monotonic, measured, 0.0).wait_for(layer, lambda: never.wait(30.0)) is None
    never.set()


def test_what_the_planner_raises_is_raised_here():
    def broken():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        PlanningClock(time.monotonic, planning_time=0.0).wait_for(Standing(), broken)


def test_timed_measures_with_the_given_clock():
    ticks = iter([1.0, 3.5])
    assert PlanningClock(lambda: next(ticks)).measure(lambda: "done") == ("done", 2.5)
