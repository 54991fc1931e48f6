"""The control loop continues during planning, for a fixed time or until the planner has finished."""

import threading
import time

import pytest

from dualbrain.runtime.planning.planning_time import PlanningClock


class HoldingExecutor:
    """An executor that only adds up how long it holds position [s]."""

    def __init__(self, interrupted_after=float("inf")):
        self.held, self._limit = 0.0, interrupted_after

    def hold(self, duration, phase):
        assert phase == "planning"
        self.held += duration
        time.sleep(0.001)

    def interrupted(self):
        return self.held >= self._limit


def test_in_lockstep_the_arm_holds_for_a_fixed_time():
    executor, released = HoldingExecutor(), threading.Event()

    def hold(duration, phase):
        HoldingExecutor.hold(executor, duration, phase)
        threading.Timer(0.05, released.set).start()  # the answer follows after the end of the hold

    executor.hold = hold
    clock = PlanningClock(time.monotonic, planning_time=2.0)
    assert clock.wait_for(HoldingExecutor(), lambda: "at once") == "at once"
    assert clock.wait_for(executor, lambda: released.wait(10.0)) is True
    assert executor.held == 2.0


def test_measured_the_arm_holds_until_the_answer():
    executor, ready = HoldingExecutor(), threading.Event()

    def propose():
        assert ready.wait(10.0)
        return "yes"

    def hold(duration, phase):
        HoldingExecutor.hold(executor, duration, phase)
        if executor.held > 0.5:
            ready.set()

    executor.hold = hold
    assert PlanningClock(time.monotonic, measured=True).wait_for(executor, propose) == "yes"
    assert executor.held > 0.5


def test_the_planner_runs_on_another_thread():
    threads = []
    PlanningClock(time.monotonic, planning_time=0.0).wait_for(
        HoldingExecutor(), lambda: threads.append(threading.current_thread())
    )
    assert threads[0] is not threading.current_thread()
    assert threads[0].daemon


@pytest.mark.parametrize("measured", [False, True])
def test_an_interruption_does_not_wait_for_the_answer(measured):
    never = threading.Event()
    executor = HoldingExecutor(interrupted_after=0.0)
    assert PlanningClock(time.monotonic, measured, 0.0).wait_for(executor, lambda: never.wait(30.0)) is None
    never.set()


def test_an_exception_of_the_planner_is_raised_by_wait_for():
    def broken_planner():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        PlanningClock(time.monotonic, planning_time=0.0).wait_for(HoldingExecutor(), broken_planner)


def test_measure_uses_the_given_clock():
    ticks = iter([1.0, 3.5])
    assert PlanningClock(lambda: next(ticks)).measure(lambda: "done") == ("done", 2.5)
