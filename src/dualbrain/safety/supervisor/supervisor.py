"""The supervisor: the conditions of a tick become one order (design 4). No clock, no input, no output of its own.

    order(t) = max over severity of { check : its condition held for `after`, and has not cleared since }

What it remembers is per check: since when its condition holds, since when it is gone, and whether the check has
tripped.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

from dualbrain.safety.supervisor.actions import NO_ACTION, SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD, Check, ClearPolicy, ContractOutcome
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition

MAX_STEP = 0.1
"""Time that one update may count for at most [s]: a clock that leaps clears nothing and lets nothing elapse."""
RESET, RESUME, CONTINUE = int(Condition.RESET), int(Condition.RESUME), int(Condition.CONTINUE)
HOLD_AFTER_RESET = SupervisorDecision(RESET_HELD.action, RESET_HELD.cause, RESET_HELD.name)


@dataclass(slots=True, kw_only=True)
class _CheckState:
    """Of one check: since when its condition holds and since when it is gone [s, own time], and whether it tripped.

    A gap that is shorter than the check's release does not end what began.
    """

    bit: int
    check: Check
    decision: SupervisorDecision
    active_since: float = inf
    gone_since: float = inf
    tripped: bool = False


class Supervisor:
    """`update(now, flags)` once a tick. The same calls give the same orders: it knows nothing else."""

    def __init__(self, checks: tuple[Check, ...] = CHECKS) -> None:
        """Nothing has happened yet. `checks` rise in severity, as in the table."""
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
        """The outcome of a contract that runs now, by the strongest check that ends contracts; "" while it goes on."""
        return self._contract_outcome

    @property
    def tripped_checks(self) -> tuple[str, ...]:
        """The names of all checks that have tripped, weakest first."""
        names = tuple(row.check.name for row in self._states if row.tripped)
        return (*names, RESET_HELD.name) if self._reset_held else names

    def update(self, now: float, flags: int) -> SupervisorDecision:
        """The order for this tick; `now` [s] need not be monotonic or finite, `flags` are `Condition` bits."""
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
        """Own time goes on by what `now` says, at most `LONGEST_STEP`; never backward."""
        step = 0.0 if self._now is None else now - self._now
        self._t += min(step, MAX_STEP) if step > 0.0 else 0.0
        self._now = now if isfinite(now) else self._now

    def _update_check(self, check_state: _CheckState, *, active: bool) -> None:
        t, check = self._t, check_state.check
        if active:
            check_state.active_since, check_state.gone_since = min(check_state.active_since, t), inf
            check_state.tripped |= t - check_state.active_since >= check.after
            return
        check_state.gone_since = min(check_state.gone_since, t)
        if t - check_state.gone_since >= check.release:
            check_state.active_since = inf
            check_state.tripped &= check.clears is not ClearPolicy.WHEN_GONE

    def _apply_buttons(self, pressed: int, flags: int) -> None:
        """Buttons count in the tick in which they are pressed; what is still wrong stays tripped."""
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
        order, ending, quiet = NO_ACTION, "", True
        for row in self._states:
            quiet = quiet and row.active_since == inf and not row.tripped
            if row.tripped:
                order = row.decision
                ending = row.check.contract_outcome or ending
        if self._reset_held and order.action < SafetyAction.HOLD:
            order = HOLD_AFTER_RESET
        self._idle, self._contract_outcome, self.decision = quiet, ending, order
        return order
