"""Driver of the Franka hand, in a separate thread because its calls block until the fingers have arrived."""

from __future__ import annotations

from threading import Condition, Thread
from typing import Any

FINGER_SPEED = 0.05
"""Rate of change of the width [m/s]: half of the value that the data sheet gives for each finger."""
MIN_OPENING_CHANGE = 5e-4
"""Change [m] of the target opening below which the target counts as unchanged."""
POLL_INTERVAL_S = 0.05
"""Interval of reading the hand while its target does not change [s]."""


class FrankaHand:
    """Opens the fingers with `move` and closes them with `grasp`; one call at a time, always for the newest target."""

    def __init__(self, gripper: Any, sdk_errors: tuple[type[Exception], ...]) -> None:
        """Start without a motion of the fingers; `sdk_errors` are the exceptions that `gripper` may raise."""
        self._gripper, self._sdk_errors = gripper, sdk_errors
        self._last_opening = 0.5 * float(gripper.read_once().width)
        self._measured: tuple[float | None, float] = (self._last_opening, 0.0)
        self._target, self._is_new = (self._last_opening, 0.0), False
        self._changed, self._closing = Condition(), False
        self._fault = ""
        self._thread = Thread(target=self._run, name="franka hand", daemon=True)
        self._thread.start()

    @property
    def measured(self) -> tuple[float | None, float]:
        """Opening [m each], and the commanded grip force [N] if an object is held, else 0.

        After an error of the hand the opening is unknown, until the hand can be read again.
        """
        return self._measured

    @property
    def fault(self) -> str:
        """The last error of the hand since `clear_fault`; "" without one."""
        return self._fault

    def clear_fault(self) -> None:
        """Forget the error; the next target is passed on even if it is the one that failed."""
        with self._changed:
            if self._fault:
                self._fault, self._target = "", (self._last_opening, 0.0)

    def set_target(self, opening: float, force: float) -> None:
        """Set the target opening [m each] and the grip force limit [N]; returns at once."""
        if abs(opening - self._target[0]) > MIN_OPENING_CHANGE or (
            force != self._target[1] and opening < self._last_opening - MIN_OPENING_CHANGE
        ):
            with self._changed:
                self._target, self._is_new = (opening, force), True
                self._changed.notify()

    def close(self) -> None:
        """End the thread; the fingers stay at their position."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._closing and not self._is_new:
                    self._changed.wait(POLL_INTERVAL_S)
                if self._closing:
                    return
                target, is_new, self._is_new = self._target, self._is_new, False
            try:
                if is_new:
                    self._move_fingers(*target)
                state = self._gripper.read_once()
            except self._sdk_errors as error:
                self._measured, self._fault = (None, 0.0), f"hand: {error}"
                continue
            self._last_opening = 0.5 * float(state.width)
            self._measured = (self._last_opening, target[1] if state.is_grasped else 0.0)

    def _move_fingers(self, opening: float, force: float) -> None:
        """Move or grasp; a grasp succeeds at any width between the target and the present width of the fingers."""
        width = 2.0 * opening
        if opening < self._last_opening - MIN_OPENING_CHANGE and force > 0.0:
            self._gripper.grasp(width, FINGER_SPEED, force, width, 2.0 * self._last_opening)
        else:
            self._gripper.move(width, FINGER_SPEED)
