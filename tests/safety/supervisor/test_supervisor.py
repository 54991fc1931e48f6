"""The supervisor's laws over all combinations of conditions, and its stories with a stepped clock."""

from collections.abc import Iterator
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest

from dualbrain.safety.supervisor.actions import NO_ACTION, Cause, SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD, ClearPolicy, render_markdown
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition
from dualbrain.safety.supervisor.supervisor import Supervisor

C = Condition
CONDITIONS = tuple(one for one in C if not one & BUTTONS)
TICK = 1e-3
SEVEREST = tuple((int(check.condition), check.action, check.name) for check in reversed(CHECKS))


def after(flags, *, ticks=1, machine=None, start=0.0):
    """The machine after `flags` held for so many ticks."""
    machine = machine or Supervisor()
    for k in range(ticks):
        machine.update(start + k * TICK, flags)
    return machine


def expected(flags) -> tuple[SafetyAction, str]:
    """The table read by hand: the last row whose condition has lasted for a second."""
    flags = int(flags)
    return next(((action, name) for bit, action, name in SEVEREST if bit & flags), (SafetyAction.NONE, ""))


def representatives() -> list[Condition]:
    """One condition for each way in which conditions can differ: the fields of the rows that they stand in.

    All combinations of these stand for all combinations, as rows with equal fields differ by name alone.
    """
    kinds: dict[tuple, Condition] = {}
    for one in CONDITIONS:
        rows = tuple(
            (check.action, check.after, check.release, check.clears, check.contract_outcome)
            for check in CHECKS
            if check.condition & one
        )
        kinds.setdefault(rows, one)
    return list(kinds.values())


def subsets(items) -> Iterator[int]:
    """The bits of every subset."""
    values = np.array([int(item) for item in items], dtype=object)
    for code in range(1 << len(items)):
        yield sum(int(value) for k, value in enumerate(values) if code >> k & 1)


# --- the table --------------------------------------------------------------------------------------------------


def test_the_table_rises_in_severity_and_every_condition_has_a_check():
    actions = [check.action for check in CHECKS]
    assert actions == sorted(actions)
    assert len({check.name for check in CHECKS}) == len(CHECKS)
    assert {one for check in CHECKS for one in check.condition} == set(CONDITIONS)
    assert set(actions) == set(SafetyAction) - {SafetyAction.NONE}


def test_what_needs_a_person_is_exactly_what_the_design_says():
    for check in CHECKS:
        assert (check.clears is ClearPolicy.WHEN_GONE) == (check.action < SafetyAction.CONTROLLED_STOP), check.name
        assert (check.clears is ClearPolicy.ON_CONTINUE) == (check.action is SafetyAction.CONTROLLED_STOP), check.name
        assert (check.clears is ClearPolicy.ON_RESTART) == (check.action is SafetyAction.LOCKOUT), check.name
        if check.action >= SafetyAction.HOLD:
            assert check.contract_outcome, f"{check.name} stops the arm and leaves its contract running"


def test_the_page_is_made_from_the_table():
    stored = Path(__file__).resolve().parents[3] / "docs" / "reference" / "safety" / "supervisor.md"
    assert stored.read_text() == render_markdown(), (
        "write it anew: python -m dualbrain.safety.supervisor.checks > docs/reference/safety/supervisor.md"
    )


# --- laws over combinations -------------------------------------------------------------------------------------


def test_all_combinations_give_the_strongest_row_and_more_never_orders_less():
    """Exhaustive over every subset of the representatives; each machine is fresh and sees the flags for one tick."""
    kinds = [one for one in representatives() if all(c.after == 0.0 for c in CHECKS if c.condition & one)]
    actions: dict[int, SafetyAction] = {}
    for flags in subsets(kinds):
        order = Supervisor().update(0.0, flags)
        assert (order.action, order.check) == expected(flags)
        actions[flags] = order.action
    bits = [int(one) for one in kinds]
    assert all(actions[flags | bit] >= action for flags, action in actions.items() for bit in bits)
    assert len(actions) == 1 << len(kinds) > 1 << 11


@pytest.mark.slow
def test_all_combinations_of_representatives_when_they_last():
    for flags in subsets(representatives()):
        machine = Supervisor()
        for k in range(7):
            order = machine.update(0.1 * k, flags)
        assert (order.action, order.check) == expected(flags)


def test_pairs_and_triples_of_all_conditions_that_last():
    for count in (1, 2, 3):
        for group in combinations(CONDITIONS, count):
            flags = sum(int(one) for one in group)
            machine = Supervisor()
            for k in range(7):
                order = machine.update(0.1 * k, flags)
            assert (order.action, order.check) == expected(flags)


def test_the_same_calls_give_the_same_orders_and_bad_clocks_never_lower_them():
    rng = np.random.default_rng(5)
    bits = [int(one) for one in C]
    for _ in range(200):
        story = [(float(t), sum(bits[k] for k in rng.choice(len(bits), 3))) for t in rng.normal(size=30)]
        story = [(np.nan if rng.random() < 0.1 else np.inf if rng.random() < 0.1 else t, flags) for t, flags in story]
        one, other = Supervisor(), Supervisor()
        for t, flags in story:
            order = one.update(t, flags)
            assert order == other.update(t, flags)
            immediate = [
                c.action
                for c in CHECKS
                if c.condition & flags and c.after == 0.0 and c.clears is not ClearPolicy.WHEN_GONE
            ]
            assert order.action >= max(immediate, default=SafetyAction.NONE) or flags & C.RESET


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_each_check_trips_when_it_says_and_clears_when_it_says(check):
    flag = int(next(iter(check.on)))
    machine, t = Supervisor(), 0.0
    while check.name not in machine.tripped_checks:
        machine.update(t, flag)
        t += TICK
        assert t < check.after + 3 * TICK
    assert t >= check.after
    last = t - TICK
    for _ in range(2500):
        machine.update(t, 0)
        if check.name not in machine.tripped_checks:
            break
        t += TICK
    if check.clears is ClearPolicy.WHEN_GONE:
        assert check.name not in machine.tripped_checks
        assert t - last == pytest.approx(max(check.release, TICK), abs=2 * TICK)
        assert machine.decision == NO_ACTION
    else:
        assert check.name in machine.tripped_checks


# --- stories ----------------------------------------------------------------------------------------------------


def play(*acts):
    """Orders after each act (seconds, flags), a tick at a time."""
    machine, t, told = Supervisor(), 0.0, []
    for seconds, flags in acts:
        for _ in range(max(1, round(seconds / TICK))):
            machine.update(t, int(flags))
            t += TICK
        told.append(machine.decision)
    return machine, told


def test_infeasible_for_less_than_50_ms_only_warns():
    _, told = play((0.045, C.INFEASIBLE), (0.15, 0), (0.045, C.INFEASIBLE), (0.2, 0))
    assert [order.action for order in told] == [
        SafetyAction.WARN,
        SafetyAction.NONE,
        SafetyAction.WARN,
        SafetyAction.NONE,
    ]


def test_infeasible_for_longer_hovers_ends_the_contract_and_clears_without_a_person():
    machine, told = play((0.06, C.INFEASIBLE))
    assert (told[0].action, told[0].cause, machine.contract_outcome) == (SafetyAction.HOVER, Cause.FILTER, "taken_over")
    machine, told = play((0.06, C.INFEASIBLE), (0.2, 0))
    assert (told[1], machine.contract_outcome) == (NO_ACTION, "")


def test_a_flickering_condition_counts_as_one_that_lasts():
    flicker = [(0.005, C.INFEASIBLE), (0.005, 0)] * 8
    _, told = play(*flicker)
    assert SafetyAction.HOVER in {order.action for order in told}
    actions = [order.action for order in told[-4:]]
    assert actions == [SafetyAction.HOVER] * 4


def test_the_emergency_stop_is_latched_and_reset_in_two_steps_into_hold():
    press, reset, resume = C.ESTOP, C.RESET, C.RESUME
    _, told = play(
        (0.1, press), (5.0, 0), (0.01, press | reset), (0.5, 0), (0.01, resume), (0.01, reset), (5.0, 0), (0.01, resume)
    )
    actions = [order.action for order in told]
    assert actions == [SafetyAction.ESTOP] * 5 + [SafetyAction.HOLD, SafetyAction.HOLD, SafetyAction.NONE]
    assert told[5].check == RESET_HELD.name


def test_a_reset_that_was_held_from_before_does_nothing():
    _, told = play((0.1, C.ESTOP), (0.1, C.ESTOP | C.RESET), (1.0, C.RESET), (0.1, 0), (0.01, C.RESET))
    assert [order.action for order in told] == [SafetyAction.ESTOP] * 4 + [SafetyAction.HOLD]


def test_reset_and_resume_in_one_press_still_land_in_hold():
    _, told = play((0.1, C.ESTOP), (0.1, 0), (0.01, C.RESET | C.RESUME), (1.0, C.RESET | C.RESUME), (0.1, 0))
    assert [order.action for order in told] == [
        SafetyAction.ESTOP,
        SafetyAction.ESTOP,
        SafetyAction.HOLD,
        SafetyAction.HOLD,
        SafetyAction.HOLD,
    ]


def test_nothing_but_a_restart_ends_a_lockout():
    buttons = (0, C.RESET, 0, C.RESUME, C.RESET | C.RESUME, 0)
    _, told = play((0.1, C.FALLING), *((2.0, flags) for flags in buttons))
    assert {order.action for order in told} == {SafetyAction.LOCKOUT}


def test_a_hold_outlives_its_weaker_cause_and_the_stronger_one_speaks():
    _, told = play((0.1, C.PAUSE), (0.2, C.PAUSE | C.LINK_LOST), (0.3, C.PAUSE), (0.1, 0))
    assert [order.check for order in told] == ["paused", "link_lost", "paused", ""]


def test_a_controlled_stop_waits_for_the_next_contract_and_that_for_the_condition_to_go():
    press = C.CONTINUE
    _, told = play((0.1, C.STATE_STALE), (0.01, C.STATE_STALE | press), (2.0, 0), (0.01, press))
    assert [order.action for order in told] == [SafetyAction.CONTROLLED_STOP] * 3 + [SafetyAction.NONE]


def test_a_new_contract_leads_out_of_no_reset_and_no_emergency_stop():
    _, told = play((0.1, C.ESTOP), (0.1, 0), (0.01, C.CONTINUE), (0.01, C.RESET), (0.1, 0), (0.01, C.CONTINUE))
    assert [order.action for order in told] == [SafetyAction.ESTOP] * 3 + [SafetyAction.HOLD] * 3


def test_a_clock_that_leaps_clears_nothing():
    machine = after(int(C.STATE_STALE), ticks=5)
    assert machine.update(1e9, 0).action is SafetyAction.CONTROLLED_STOP
    assert machine.update(-1e9, 0).action is SafetyAction.CONTROLLED_STOP
    assert machine.update(float("nan"), 0).action is SafetyAction.CONTROLLED_STOP


def test_two_channels_that_contradict_each_other_lock_out_after_half_a_second():
    _, told = play((0.45, C.ESTOP | C.ESTOP_DISAGREE), (0.1, C.ESTOP | C.ESTOP_DISAGREE))
    assert [order.action for order in told] == [SafetyAction.ESTOP, SafetyAction.LOCKOUT]


def test_latches_never_open_by_any_flags_but_a_fresh_reset():
    rng = np.random.default_rng(1)
    bits = [int(one) for one in CONDITIONS]
    latched = [int(c.condition) for c in CHECKS if c.clears is ClearPolicy.ON_TWO_STEP_RESET]
    for latch, resume in product(latched, (0, int(C.RESUME))):
        machine = after(latch, ticks=2)
        for k in range(300):
            flags = sum(bits[j] for j in rng.choice(len(bits), 2, replace=False)) if k % 3 == 0 else resume * (k % 2)
            assert machine.update(0.01 * k, flags).action >= SafetyAction.ESTOP
