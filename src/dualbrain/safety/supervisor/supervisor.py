"""The supervisor: the conditions of a tick become one order (design 4). No clock, no input, no output of its own.

    order(t) = max over severity of { check : its condition held for `after`, and has not cleared since }

What it remembers is per check: since when its condition holds, since when it is gone, and whether the check has
tripped.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

from dualbrain.safety.supervisor.actions import FREE, Order, Rung
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD, Check, Clears, Ending
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition

LONGEST_STEP = 0.1
"""Time that one update may count for at most [s]: a clock that leaps clears nothing and lets nothing elapse."""
RESET, RESUME, CONTINUE = int(Condition.RESET), int(Condition.RESUME), int(Condition.CONTINUE)
HOLD = Order(RESET_HELD.action, RESET_HELD.cause, RESET_HELD.name)


@dataclass(slots=True)
class _Memory:
    """Of one check: since when its condition holds and since when it is gone [s, own time], and whether it tripped.

    A gap that is shorter than the check's release does not end what began.
    """

    bit: int
    check: Check
    order: Order
    since: float = inf
    gone: float = inf
    tripped: bool = False


class Supervisor:
    """`update(now, flags)` once a tick. The same calls give the same orders: it knows nothing else."""

    def __init__(self, checks: tuple[Check, ...] = CHECKS) -> None:
        """Nothing has happened yet. `checks` rise in severity, as in the table."""
        self._rows = tuple(
            _Memory(int(check.on), check, Order(check.action, check.cause, check.name, check.at_once))
            for check in checks
        )
        self._watched = 0
        for row in self._rows:
            self._watched |= row.bit
        self._now: float | None = None
        self._t = 0.0
        self._quiet = True
        self._held = False
        self._buttons = 0
        self._ending: Ending = ""
        self.order = FREE

    @property
    def ending(self) -> Ending:
        """The outcome of a contract that runs now, by the strongest check that ends contracts; "" while it goes on."""
        return self._ending

    @property
    def tripped(self) -> tuple[str, ...]:
        """The names of all checks that have tripped, weakest first."""
        names = tuple(row.check.name for row in self._rows if row.tripped)
        return (*names, RESET_HELD.name) if self._held else names

    def update(self, now: float, flags: int) -> Order:
        """The order for this tick; `now` [s] need not be monotonic or finite, `flags` are `Condition` bits."""
        self._elapse(now)
        flags = int(flags)
        pressed, self._buttons = flags & ~self._buttons & BUTTONS, flags & BUTTONS
        if self._quiet and not flags & self._watched and not self._held:
            return self.order
        for row in self._rows:
            self._judge(row, seen=bool(flags & row.bit))
        if pressed:
            self._press(pressed, flags)
        return self._decide()

    def _elapse(self, now: float) -> None:
        """Own time goes on by what `now` says, at most `LONGEST_STEP`; never backward."""
        step = 0.0 if self._now is None else now - self._now
        self._t += min(step, LONGEST_STEP) if step > 0.0 else 0.0
        self._now = now if isfinite(now) else self._now

    def _judge(self, row: _Memory, *, seen: bool) -> None:
        t, check = self._t, row.check
        if seen:
            row.since, row.gone = min(row.since, t), inf
            row.tripped |= t - row.since >= check.after
            return
        row.gone = min(row.gone, t)
        if t - row.gone >= check.release:
            row.since = inf
            row.tripped &= check.clears is not Clears.WHEN_GONE

    def _press(self, pressed: int, flags: int) -> None:
        """Buttons count in the tick in which they are pressed; what is still wrong stays tripped."""
        latched = [row for row in self._rows if row.tripped and row.check.clears is Clears.ON_TWO_STEP_RESET]
        if pressed & RESET and latched and not any(flags & row.bit for row in latched):
            for row in latched:
                row.tripped = False
            self._held = True
        elif pressed & RESUME:
            self._held = False
        if pressed & (RESUME | CONTINUE):
            for row in self._rows:
                row.tripped &= row.check.clears is not Clears.ON_CONTINUE or row.since < inf

    def _decide(self) -> Order:
        order, ending, quiet = FREE, "", True
        for row in self._rows:
            quiet = quiet and row.since == inf and not row.tripped
            if row.tripped:
                order = row.order
                ending = row.check.ending or ending
        if self._held and order.action < Rung.HOLD:
            order = HOLD
        self._quiet, self._ending, self.order = quiet, ending, order
        return order
