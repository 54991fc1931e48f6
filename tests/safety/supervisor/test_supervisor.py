"""Supervisor: laws over all combinations of conditions, and sequences of conditions with a stepped clock."""

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
CONDITIONS = tuple(condition for condition in C if not condition & BUTTONS)
TICK = 1e-3
SEVEREST = tuple((int(check.condition), check.action, check.name) for check in reversed(CHECKS))


def after(flags, *, ticks=1, machine=None, start=0.0):
    """The supervisor after `flags` were present for `ticks` ticks."""
    machine = machine or Supervisor()
    for k in range(ticks):
        machine.update(start + k * TICK, flags)
    return machine


def expected(flags) -> tuple[SafetyAction, str]:
    """The expected decision by the table: the last row whose condition has been present for a second."""
    flags = int(flags)
    return next(((action, name) for bit, action, name in SEVEREST if bit & flags), (SafetyAction.NONE, ""))


def representatives() -> list[Condition]:
    """One condition for each distinct set of rows that conditions appear in, compared by their fields.

    Combinations of these conditions cover all combinations, because rows with equal fields differ only by name.
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


def test_clear_policies_follow_the_severity_of_the_action():
    for check in CHECKS:
        assert (check.clears is ClearPolicy.WHEN_GONE) == (check.action < SafetyAction.CONTROLLED_STOP), check.name
        assert (check.clears is ClearPolicy.ON_CONTINUE) == (check.action is SafetyAction.CONTROLLED_STOP), check.name
        assert (check.clears is ClearPolicy.ON_RESTART) == (check.action is SafetyAction.LOCKOUT), check.name
        if check.action >= SafetyAction.HOLD:
            assert check.contract_outcome, f"{check.name} stops the arm and leaves its contract running"


def test_the_page_matches_the_table():
    stored = Path(__file__).resolve().parents[3] / "docs" / "reference" / "safety" / "supervisor.md"
    assert stored.read_text() == render_markdown(), (
        "regenerate the page: python -m dualbrain.safety.supervisor.checks > docs/reference/safety/supervisor.md"
    )


# --- laws over combinations -------------------------------------------------------------------------------------


def test_combinations_give_the_strongest_row_and_more_conditions_never_a_weaker_action():
    """Exhaustive over every subset of the representatives; each supervisor is new and gets the flags for one tick."""
    kinds = [one for one in representatives() if all(c.after == 0.0 for c in CHECKS if c.condition & one)]
    actions: dict[int, SafetyAction] = {}
    for flags in subsets(kinds):
        decision = Supervisor().update(0.0, flags)
        assert (decision.action, decision.check) == expected(flags)
        actions[flags] = decision.action
    bits = [int(one) for one in kinds]
    assert all(actions[flags | bit] >= action for flags, action in actions.items() for bit in bits)
    assert len(actions) == 1 << len(kinds) > 1 << 11


@pytest.mark.slow
def test_all_combinations_of_representatives_when_they_last():
    for flags in subsets(representatives()):
        machine = Supervisor()
        for k in range(7):
            decision = machine.update(0.1 * k, flags)
        assert (decision.action, decision.check) == expected(flags)


def test_pairs_and_triples_of_all_conditions_that_last():
    for count in (1, 2, 3):
        for group in combinations(CONDITIONS, count):
            flags = sum(int(one) for one in group)
            machine = Supervisor()
            for k in range(7):
                decision = machine.update(0.1 * k, flags)
            assert (decision.action, decision.check) == expected(flags)


def test_equal_calls_give_equal_decisions_and_bad_clocks_never_weaken_them():
    rng = np.random.default_rng(5)
    bits = [int(one) for one in C]
    for _ in range(200):
        calls = [(float(t), sum(bits[k] for k in rng.choice(len(bits), 3))) for t in rng.normal(size=30)]
        calls = [(np.nan if rng.random() < 0.1 else np.inf if rng.random() < 0.1 else t, flags) for t, flags in calls]
        one, other = Supervisor(), Supervisor()
        for t, flags in calls:
            decision = one.update(t, flags)
            assert decision == other.update(t, flags)
            immediate = [
                c.action
                for c in CHECKS
                if c.condition & flags and c.after == 0.0 and c.clears is not ClearPolicy.WHEN_GONE
            ]
            assert decision.action >= max(immediate, default=SafetyAction.NONE) or flags & C.RESET


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_each_check_trips_and_clears_at_its_times(check):
    flag = int(next(iter(check.condition)))
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


# --- sequences --------------------------------------------------------------------------------------------------


def play(*segments):
    """The supervisor and its decision after each segment (seconds, flags), one tick at a time."""
    machine, t, decisions = Supervisor(), 0.0, []
    for seconds, flags in segments:
        for _ in range(max(1, round(seconds / TICK))):
            machine.update(t, int(flags))
            t += TICK
        decisions.append(machine.decision)
    return machine, decisions


def test_infeasible_for_less_than_50_ms_only_warns():
    _, decisions = play((0.045, C.INFEASIBLE), (0.15, 0), (0.045, C.INFEASIBLE), (0.2, 0))
    assert [decision.action for decision in decisions] == [
        SafetyAction.WARN,
        SafetyAction.NONE,
        SafetyAction.WARN,
        SafetyAction.NONE,
    ]


def test_infeasible_for_longer_hovers_ends_the_contract_and_clears_without_a_person():
    machine, decisions = play((0.06, C.INFEASIBLE))
    decision = decisions[0]
    assert (decision.action, decision.cause, machine.contract_outcome) == (
        SafetyAction.HOVER,
        Cause.FILTER,
        "taken_over",
    )
    machine, decisions = play((0.06, C.INFEASIBLE), (0.2, 0))
    assert (decisions[1], machine.contract_outcome) == (NO_ACTION, "")


def test_a_flickering_condition_counts_as_one_that_lasts():
    flicker = [(0.005, C.INFEASIBLE), (0.005, 0)] * 8
    _, decisions = play(*flicker)
    assert SafetyAction.HOVER in {decision.action for decision in decisions}
    actions = [decision.action for decision in decisions[-4:]]
    assert actions == [SafetyAction.HOVER] * 4


def test_the_emergency_stop_is_latched_and_reset_in_two_steps_into_hold():
    press, reset, resume = C.ESTOP, C.RESET, C.RESUME
    _, decisions = play(
        (0.1, press), (5.0, 0), (0.01, press | reset), (0.5, 0), (0.01, resume), (0.01, reset), (5.0, 0), (0.01, resume)
    )
    actions = [decision.action for decision in decisions]
    assert actions == [SafetyAction.ESTOP] * 5 + [SafetyAction.HOLD, SafetyAction.HOLD, SafetyAction.NONE]
    assert decisions[5].check == RESET_HELD.name


def test_a_reset_button_that_is_held_since_before_has_no_effect():
    _, decisions = play((0.1, C.ESTOP), (0.1, C.ESTOP | C.RESET), (1.0, C.RESET), (0.1, 0), (0.01, C.RESET))
    assert [decision.action for decision in decisions] == [SafetyAction.ESTOP] * 4 + [SafetyAction.HOLD]


def test_reset_and_resume_in_one_press_still_lead_to_hold():
    _, decisions = play((0.1, C.ESTOP), (0.1, 0), (0.01, C.RESET | C.RESUME), (1.0, C.RESET | C.RESUME), (0.1, 0))
    assert [decision.action for decision in decisions] == [
        SafetyAction.ESTOP,
        SafetyAction.ESTOP,
        SafetyAction.HOLD,
        SafetyAction.HOLD,
        SafetyAction.HOLD,
    ]


def test_nothing_but_a_restart_ends_a_lockout():
    buttons = (0, C.RESET, 0, C.RESUME, C.RESET | C.RESUME, 0)
    _, decisions = play((0.1, C.FALLING), *((2.0, flags) for flags in buttons))
    assert {decision.action for decision in decisions} == {SafetyAction.LOCKOUT}


def test_the_strongest_present_condition_determines_the_decision():
    _, decisions = play((0.1, C.PAUSE), (0.2, C.PAUSE | C.LINK_LOST), (0.3, C.PAUSE), (0.1, 0))
    assert [decision.check for decision in decisions] == ["paused", "link_lost", "paused", ""]


def test_a_controlled_stop_clears_with_the_first_contract_after_its_condition():
    press = C.CONTINUE
    _, decisions = play((0.1, C.STATE_STALE), (0.01, C.STATE_STALE | press), (2.0, 0), (0.01, press))
    assert [decision.action for decision in decisions] == [SafetyAction.CONTROLLED_STOP] * 3 + [SafetyAction.NONE]


def test_a_new_contract_clears_neither_an_emergency_stop_nor_the_hold_after_it():
    _, decisions = play((0.1, C.ESTOP), (0.1, 0), (0.01, C.CONTINUE), (0.01, C.RESET), (0.1, 0), (0.01, C.CONTINUE))
    assert [decision.action for decision in decisions] == [SafetyAction.ESTOP] * 3 + [SafetyAction.HOLD] * 3


def test_a_clock_jump_clears_nothing():
    machine = after(int(C.STATE_STALE), ticks=5)
    assert machine.update(1e9, 0).action is SafetyAction.CONTROLLED_STOP
    assert machine.update(-1e9, 0).action is SafetyAction.CONTROLLED_STOP
    assert machine.update(float("nan"), 0).action is SafetyAction.CONTROLLED_STOP


def test_two_channels_that_contradict_each_other_lock_out_after_half_a_second():
    _, decisions = play((0.45, C.ESTOP | C.ESTOP_DISAGREE), (0.1, C.ESTOP | C.ESTOP_DISAGREE))
    assert [decision.action for decision in decisions] == [SafetyAction.ESTOP, SafetyAction.LOCKOUT]


def test_only_a_new_reset_clears_latched_checks():
    rng = np.random.default_rng(1)
    bits = [int(one) for one in CONDITIONS]
    latched = [int(c.condition) for c in CHECKS if c.clears is ClearPolicy.ON_TWO_STEP_RESET]
    for latch, resume in product(latched, (0, int(C.RESUME))):
        machine = after(latch, ticks=2)
        for k in range(300):
            flags = sum(bits[j] for j in rng.choice(len(bits), 2, replace=False)) if k % 3 == 0 else resume * (k % 2)
            assert machine.update(0.01 * k, flags).action >= SafetyAction.ESTOP
