"""Supervisor: maps the conditions of a tick to one decision (design 4), without clock, input or output of its own.

    decision(t) = strongest check whose condition lasted for `after` and that has not cleared since

The state per check: since when its condition is present, since when it is gone, and whether the check has tripped.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

from dualbrain.safety.supervisor.actions import NO_ACTION, SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD, Check, ClearPolicy, ContractOutcome
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition

MAX_STEP = 0.1
"""Largest time step of one update [s], so that a clock jump neither trips nor clears a check."""
ROUNDING = 5e-7
"""Half of the microsecond in which the supervisor in C counts [s]: both decide alike at a time that equals a limit."""
RESET, RESUME, CONTINUE = int(Condition.RESET), int(Condition.RESUME), int(Condition.CONTINUE)
HOLD_AFTER_RESET = SupervisorDecision(RESET_HELD.action, RESET_HELD.cause, RESET_HELD.name)


@dataclass(slots=True, kw_only=True)
class _CheckState:
    """State of one check: since when its condition is present or gone [s, internal time], and whether it has tripped.

    A gap in the condition that is shorter than `Check.release` does not reset `active_since`.
    """

    bit: int
    check: Check
    decision: SupervisorDecision
    active_since: float = inf
    gone_since: float = inf
    tripped: bool = False


class Supervisor:
    """State machine with one `update(now, flags)` per tick; equal calls give equal decisions."""

    def __init__(self, checks: tuple[Check, ...] = CHECKS) -> None:
        """Start without tripped checks; `checks` are in the order of severity."""
        self._states = tuple(
            _CheckState(
                bit=int(check.condition),
                check=check,
                decision=SupervisorDecision(check.action, check.cause, check.name, check.immediate_drive_off),
            )
            for check in checks
        )
        self._watched_bits = 0
        for row in self._states:
            self._watched_bits |= row.bit
        self._now: float | None = None
        self._t = 0.0
        self._idle = True
        self._reset_held = False
        self._pressed = 0
        self._contract_outcome: ContractOutcome = ""
        self.decision = NO_ACTION

    @property
    def contract_outcome(self) -> ContractOutcome:
        """Outcome of the running contract by the strongest check that ends contracts; "" while it continues."""
        return self._contract_outcome

    @property
    def tripped_checks(self) -> tuple[str, ...]:
        """Names of all tripped checks, weakest first."""
        names = tuple(row.check.name for row in self._states if row.tripped)
        return (*names, RESET_HELD.name) if self._reset_held else names

    def update(self, now: float, flags: int) -> SupervisorDecision:
        """The decision for this tick; `now` [s] need not be monotonic or finite, `flags` are `Condition` bits."""
        self._advance_time(now)
        flags = int(flags)
        pressed, self._pressed = flags & ~self._pressed & BUTTONS, flags & BUTTONS
        if self._idle and not flags & self._watched_bits and not self._reset_held:
            return self.decision
        for row in self._states:
            self._update_check(row, active=bool(flags & row.bit))
        if pressed:
            self._apply_buttons(pressed, flags)
        return self._decide()

    def _advance_time(self, now: float) -> None:
        """Advance the internal time to `now`, by at most `MAX_STEP` and never backward."""
        step = 0.0 if self._now is None else now - self._now
        self._t += min(step, MAX_STEP) if step > 0.0 else 0.0
        self._now = now if isfinite(now) else self._now

    def _update_check(self, check_state: _CheckState, *, active: bool) -> None:
        t, check = self._t, check_state.check
        if active:
            check_state.active_since, check_state.gone_since = min(check_state.active_since, t), inf
            check_state.tripped |= t - check_state.active_since >= check.after - ROUNDING
            return
        check_state.gone_since = min(check_state.gone_since, t)
        if t - check_state.gone_since >= check.release - ROUNDING:
            check_state.active_since = inf
            check_state.tripped &= check.clears is not ClearPolicy.WHEN_GONE

    def _apply_buttons(self, pressed: int, flags: int) -> None:
        """Apply buttons in the tick in which they are pressed; checks with a present condition stay tripped."""
        latched = [row for row in self._states if row.tripped and row.check.clears is ClearPolicy.ON_TWO_STEP_RESET]
        if pressed & RESET and latched and not any(flags & row.bit for row in latched):
            for row in latched:
                row.tripped = False
            self._reset_held = True
        elif pressed & RESUME:
            self._reset_held = False
        if pressed & (RESUME | CONTINUE):
            for row in self._states:
                row.tripped &= row.check.clears is not ClearPolicy.ON_CONTINUE or row.active_since < inf

    def _decide(self) -> SupervisorDecision:
        decision, outcome, quiet = NO_ACTION, "", True
        for row in self._states:
            quiet = quiet and row.active_since == inf and not row.tripped
            if row.tripped:
                decision = row.decision
                outcome = row.check.contract_outcome or outcome
        if self._reset_held and decision.action < SafetyAction.HOLD:
            decision = HOLD_AFTER_RESET
        self._idle, self._contract_outcome, self.decision = quiet, outcome, decision
        return decision
