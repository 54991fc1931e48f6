"""The supervisor in C decides as the supervisor in Python, for any conditions; the generated tables are up to date."""

import ctypes
from itertools import combinations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dualbrain.robots.interface import RobotState
from dualbrain.safety.supervisor.actions import SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.enforcement import Enforcement
from dualbrain.safety.supervisor.supervisor import Supervisor
from dualbrain.safety.target.supervisor_tables import HEADER_FILE, SOURCE_FILE, render_header, render_source
from tests.firmware.c_library import ROOT, load_library

STEP_US = 15625
"""1/64 s: the same time in microseconds and in float64, without rounding."""
N, JOINTS = len(CHECKS), 8
NAMES = [*(check.name for check in CHECKS), RESET_HELD.name]
BITS = st.sets(st.sampled_from(list(Condition)), max_size=4).map(lambda bits: int(sum(bits)))


class Decision(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint8) for name in ("action", "check", "drive_off", "ends_contract")]


class SupervisorMemory(ctypes.Structure):
    _fields_ = [
        ("active_since", ctypes.c_uint64 * N),
        ("gone_since", ctypes.c_uint64 * N),
        ("tripped", ctypes.c_uint8 * N),
        ("started", ctypes.c_uint8),
        ("reset_held", ctypes.c_uint8),
        ("now_us", ctypes.c_uint64),
        ("time_us", ctypes.c_uint64),
        ("pressed", ctypes.c_uint64),
        ("decision", Decision),
    ]


class StandstillMemory(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_uint8) for name in ("drive_wanted", "at_standstill", "stopping", "drive_off_known")),
        ("stop_since_us", ctypes.c_uint64),
        ("drive_off_us", ctypes.c_uint64),
        *((name, ctypes.c_float * JOINTS) for name in ("standstill_q", "drive_off_q", "coast_limit")),
    ]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    sources = [f"kernel/supervisor/dbk_{name}.c" for name in ("supervisor", "checks", "standstill")]
    found = load_library(tmp_path_factory.mktemp("supervisor"), *sources)
    found.dbk_supervisor_update.restype = Decision
    found.dbk_standstill_apply.restype = ctypes.c_uint64
    return found


class InC:
    """The supervisor in C behind the interface of the one in Python."""

    def __init__(self, library):
        self._library, self._memory = library, SupervisorMemory()
        library.dbk_supervisor_init(ctypes.byref(self._memory))

    def update(self, time_us, flags):
        found = self._library.dbk_supervisor_update(
            ctypes.byref(self._memory), ctypes.c_uint64(time_us), ctypes.c_uint64(flags)
        )
        return found.action, NAMES[found.check] if found.check <= N else "", bool(found.drive_off)


def in_python(supervisor, time_us, flags):
    decision = supervisor.update(time_us / 1e6, flags)
    return int(decision.action), decision.check, decision.immediate_drive_off


def test_the_generated_files_are_up_to_date():
    assert (ROOT / "kernel" / HEADER_FILE).read_text() == render_header()
    assert (ROOT / "kernel" / SOURCE_FILE).read_text() == render_source()


@settings(max_examples=300, deadline=None)
@example(steps=[(0, 0), (5, int(Condition.HEARTBEAT_LOST)), (5, 0), (30, 0)])  # the largest step equals the release
@given(steps=st.lists(st.tuples(st.sampled_from([0, 1, 2, 5, 30, 100]), BITS), max_size=60))
def test_any_sequence_of_conditions_gives_the_same_decisions(library, steps):
    c, python, time_us = InC(library), Supervisor(), 0
    for wait, flags in steps:
        time_us += wait * STEP_US
        assert c.update(time_us, flags) == in_python(python, time_us, flags)


def test_all_pairs_of_conditions_decide_alike_from_their_first_tick_until_after_a_reset(library):
    buttons = [0, int(Condition.RESET), int(Condition.RESUME), int(Condition.CONTINUE)]
    pairs = [0, *map(int, Condition), *(int(a | b) for a, b in combinations(Condition, 2))]
    for flags in pairs:
        c, python = InC(library), Supervisor()
        given = [flags] * 6 + [0] * 40 + buttons
        for tick, one in enumerate(given):
            assert c.update(tick * STEP_US, one) == in_python(python, tick * STEP_US, one), (flags, tick)


def test_a_reset_button_that_is_held_since_before_has_no_effect(library):
    """Only a new press counts, on both sides."""
    c, python = InC(library), Supervisor()
    held, estop = int(Condition.RESET), int(Condition.ESTOP)
    for tick, flags in enumerate([held | estop, held | estop, *[held] * 5, 0, held]):
        decision = c.update(tick * STEP_US, flags)
        assert decision == in_python(python, tick * STEP_US, flags)
        assert (decision[1] == "estop") == (tick < 8)


def test_a_clock_that_runs_backward_or_jumps_changes_nothing(library):
    c, python = InC(library), Supervisor()
    flags = int(Condition.INFEASIBLE)
    for time_us in (10 * STEP_US, 0, 3 * STEP_US, 2**40 * STEP_US, 5, 2**40 * STEP_US):
        assert c.update(time_us, flags) == in_python(python, time_us, flags)


ACTIONS = st.sampled_from(list(SafetyAction))
MOTION = st.lists(st.sampled_from([0.0, 0.0078125, -0.0234375, 0.0625]), min_size=3, max_size=3)
"""Away from the limits, where float32 and float64 round differently."""


@settings(max_examples=300, deadline=None)
@given(
    ticks=st.lists(
        st.tuples(ACTIONS, st.booleans(), st.booleans(), MOTION, st.sampled_from([0.0, 0.001, 0.5, float("nan")])),
        max_size=60,
    )
)
def test_standstill_and_drive_are_those_of_the_host(library, ticks):
    """At any decisions, displacements and velocities, also NaN."""
    memory, python = StandstillMemory(), Enforcement()
    library.dbk_standstill_init(ctypes.byref(memory))
    for tick, (action, off, yielding, q, speed) in enumerate(ticks):
        stamp = (tick + 1) * 2.0**-2
        q32, v32 = np.array(q, np.float32), np.full(3, speed, np.float32)
        state = RobotState(
            stamp=stamp, sequence=tick, q=q32.astype(float), v=v32.astype(float), opening=0.0, finger_forces=(0.0, 0.0)
        )
        expected = python.apply(SupervisorDecision(action, immediate_drive_off=off), state, retreating=yielding)
        decision = Decision(int(action), 0, int(off), 0)
        joints = [values.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for values in (q32, v32)]
        time_us = ctypes.c_uint64(round(stamp * 1e6))
        found = library.dbk_standstill_apply(ctypes.byref(memory), decision, int(yielding), 3, *joints, time_us)
        assert found == expected
        assert (bool(memory.drive_wanted), bool(memory.at_standstill)) == (python.drive_wanted, python.at_standstill)
