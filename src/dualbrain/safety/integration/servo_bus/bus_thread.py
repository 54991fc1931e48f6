"""The thread that owns a servo bus: it reads the joints, and writes the newest safe values in every period.

A policy sends actions at its own rate from another thread; the newest one counts. Only this thread writes to the bus.
A reading or writing that fails, a stalled policy, and a second sender bring the arm to rest; the servos then hold the
last commanded position.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.guarded_servos import GuardedServos, ServoState

logger = logging.getLogger(__name__)

ANSWER_TIMEOUT = 0.5
"""Longest time [s] that `send` waits for the first period of its action."""
SENDER_MEMORY = 0.5
"""Time [s] since the last action of a sender within which all actions of another are refused; at least two actions."""
LATE_PERIODS = 2
"""A period that begins later than this many periods counts as late."""
LATE_SHARE = 0.05
"""Share of late periods above which `stop` logs a warning."""
TWO_SENDERS = (
    "Two threads send actions; the arm comes to rest. Remedy: let one policy or one operator command the arm at a time"
)
NO_ANSWER = (
    f"The bus has not answered for {ANSWER_TIMEOUT:g} s: the action is withdrawn, and the arm comes to rest. Remedy: "
    "check cable and port"
)

Reader = Callable[[], Mapping[str, Any]]
Writer = Callable[[Mapping[str, float]], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class BusTiming:
    """Periods of the thread: their number, how many began late, and the longest time between two [s]."""

    periods: int
    late: int
    longest: float


class BusThread:
    """Runs `servos` on a bus: `read` gives values [deg] by servo, `write` takes them.

    State: the newest action that waits for the next period, the newest reading, and the timing of the periods.
    """

    def __init__(
        self,
        servos: GuardedServos,
        read: Reader,
        write: Writer,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Own the bus of `read` and `write` from `start` to `stop`; `clock` [s] must not jump."""
        self.servos = servos
        self._read, self._write, self._clock = read, write, clock
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._sent = self._done = 0
        self._sender_memory = max(SENDER_MEMORY, 2.0 * servos.action_period)
        self._clear()

    def _clear(self) -> None:
        """Forget everything of the session before."""
        self._stopping = False
        self._failure: BaseException | None = None
        self._withdraw()
        self._senders: dict[int, float] = {}
        self._problem = self._logged = ""
        self._reading: Mapping[str, Any] = {}
        self._state = ServoState(written={}, intervened=False, intervening=False, problem="")
        self._intervened = False
        self._periods, self._late, self._longest, self._last = 0, 0, 0.0, float("nan")

    # --- the side of the policy -----------------------------------------------------------------------------------

    def start(self, commanded: Mapping[str, Any] | None = None) -> None:
        """Start the thread; `commanded` are the values [deg] that the servos hold now, if they are known."""
        if self._thread is not None:
            raise ConfigurationError.stating("The bus thread runs already.", fix="Call `stop` first.")
        self.servos.reset(commanded)
        with self._changed:
            self._clear()
        self._thread = threading.Thread(target=self._run, name="dualbrain-servo-bus", daemon=True)
        try:
            self._thread.start()
        except BaseException:
            self._thread = None
            raise

    def stop(self) -> None:
        """End the thread, and forget an action that waits; the servos hold the last commanded position."""
        thread, self._thread = self._thread, None
        with self._changed:
            self._stopping = True
            self._withdraw()
            self._changed.notify_all()
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        if self._late > LATE_SHARE * self._periods:
            logger.warning(
                "%d of %d periods of the servo bus began late, the longest after %.0f ms: the arm was slower than "
                "commanded. Remedy: lower the rate of the bus, or look at machine load and the latency of the port.",
                self._late,
                self._periods,
                1e3 * self._longest,
            )

    @property
    def is_running(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def is_current(self) -> bool:
        """Whether the caller is this thread."""
        return self._thread is threading.current_thread()

    @property
    def reading(self) -> Mapping[str, Any]:
        """The newest reading; empty before the first."""
        return self._reading

    @property
    def state(self) -> ServoState:
        """What the guard did since the last action began, after its last period."""
        return self._state

    @property
    def timing(self) -> BusTiming:
        """The timing of the periods so far."""
        return BusTiming(periods=self._periods, late=self._late, longest=self._longest)

    def send(self, action: Any) -> ServoState:
        """Make `action` the newest one, wait for its first period, and return the state after that.

        If the bus does not answer within `ANSWER_TIMEOUT`, the action is withdrawn and the state has the problem.

        Raises:
            ConfigurationError: the thread does not run; the message states why.
        """
        with self._changed:
            self._require_running()
            number = self._post(action, threading.get_ident())
            answered = self._changed.wait_for(lambda: self._done >= number or self._stopping, ANSWER_TIMEOUT)
            self._require_running()
            return self._state if answered else self._give_up()

    def _post(self, action: Any, sender: int) -> int:
        """Let `action` wait for the next period, or a problem while there is another sender; gives its number."""
        now = self._clock()
        with self._changed:
            recent = {one: time for one, time in self._senders.items() if now - time < self._sender_memory}
            self._senders = recent | {sender: now}
            if len(self._senders) > 1:
                self._withdraw()
                self._problem = TWO_SENDERS
            else:
                self._action, self._waiting = action, True
            self._sent += 1
            self._changed.notify_all()
            return self._sent

    def _withdraw(self) -> None:
        self._action: Any = None
        self._waiting = False

    def _give_up(self) -> ServoState:
        """Withdraw the action that the bus has not taken; one that it has taken ends in the next period."""
        self._withdraw()
        self._problem = NO_ANSWER
        self._log_problem(NO_ANSWER)
        return replace(self._state, intervened=True, intervening=True, problem=NO_ANSWER)

    def take_intervention(self) -> bool:
        """Whether barriers or a problem changed the motion since the last call."""
        with self._changed:
            found, self._intervened = self._intervened, False
        return found

    def refuse(self, problem: str) -> None:
        """Bring the arm to rest with the `problem` from the next period on, until the next action."""
        with self._changed:
            self._problem = problem

    def _require_running(self) -> None:
        if self._failure is not None:
            raise ConfigurationError.stating(
                f"The bus thread has ended: {self._failure}.",
                fix="Check the connection of the arm, then connect again.",
            )
        if not self.is_running:
            raise ConfigurationError.stating("The bus thread does not run.", fix="Connect the robot first.")

    # --- the side of the bus --------------------------------------------------------------------------------------

    def run_period(self) -> None:
        """One period: read, take the newest action, filter, write."""
        now = self._clock()
        self._count(now)
        reading, problem = self._try_read()
        with self._changed:
            action, waiting, number = self._action, self._waiting, self._sent
            problem = self._problem or problem
            self._withdraw()
            self._problem, self._reading = "", reading or self._reading
        if problem:
            self.servos.rest(problem, now)
        elif waiting:
            self.servos.begin(action, now)
        values = self.servos.step(reading, now)
        if values:
            self._try_write(values)
        with self._changed:
            self._state, self._done = self.servos.state, number
            self._intervened = self._intervened or self._state.intervening
            self._changed.notify_all()
        self._log_problem(self._state.problem)

    def _run(self) -> None:
        period, due = self.servos.period, self._clock()
        try:
            while not self._stopping:
                self.run_period()
                due = max(due + period, self._clock())
                with self._changed:
                    self._changed.wait_for(lambda: self._stopping, max(0.0, due - self._clock()))
        except BaseException as error:
            logger.exception("The servo bus thread has ended; the servos hold their last command.")
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _try_read(self) -> tuple[Mapping[str, Any], str]:
        try:
            return self._read(), ""
        except Exception as error:
            return {}, f"The joints could not be read: {error}; the arm comes to rest. Remedy: check cable and power"

    def _try_write(self, values: Mapping[str, float]) -> None:
        try:
            self._write(values)
        except Exception as error:
            problem = f"The servos could not be written: {error}; the arm comes to rest. Remedy: check cable and power"
            self.refuse(problem)

    def _count(self, now: float) -> None:
        gap = now - self._last
        if gap > 0.0:
            self._longest = max(self._longest, gap)
            self._late += gap > LATE_PERIODS * self.servos.period
        self._periods, self._last = self._periods + 1, now

    def _log_problem(self, problem: str) -> None:
        if problem and problem != self._logged:
            logger.warning("%s.", problem.rstrip("."))
        self._logged = problem
