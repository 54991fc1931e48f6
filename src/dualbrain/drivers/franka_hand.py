"""Driver of the Franka hand, in threads of its own because its calls block until the fingers have arrived.

One thread moves the fingers, and another one reads them, also while they move: the members of the vendor's class may be
called from several threads.
"""

from __future__ import annotations

from threading import Condition, Thread
from typing import Any

FINGER_SPEED = 0.05
"""Rate of change of the width [m/s]: half of the value that the data sheet gives for each finger."""
MIN_OPENING_CHANGE = 5e-4
"""Change [m] of the target opening below which the target counts as unchanged."""
POLL_INTERVAL_S = 0.05
"""Longest interval between two readings of a hand whose target does not change [s]."""
MOVING_POLL_INTERVAL_S = 0.01
"""Interval between two readings while the fingers move [s]; at `FINGER_SPEED` the width then changes by 0.5 mm."""


class FrankaHand:
    """Opens the fingers with `move` and closes them with `grasp`; one call at a time, always for the newest target."""

    def __init__(self, gripper: Any, sdk_errors: tuple[type[Exception], ...]) -> None:
        """Start without a motion of the fingers; `sdk_errors` are the exceptions that `gripper` may raise."""
        self._gripper, self._sdk_errors = gripper, sdk_errors
        self._last_opening = 0.5 * float(gripper.read_once().width)
        self._measured: tuple[float | None, float] = (self._last_opening, 0.0)
        self._target, self._is_new = (self._last_opening, 0.0), False
        self._is_moving, self._applied_force = False, 0.0
        self._changed, self._closing = Condition(), False
        self._fault = ""
        self._threads = tuple(
            Thread(target=run, name=name, daemon=True)
            for run, name in ((self._move_newest, "franka hand"), (self._read, "franka hand state"))
        )
        for thread in self._threads:
            thread.start()

    @property
    def measured(self) -> tuple[float | None, float]:
        """Opening [m each], and the commanded grip force [N] if an object is held, else 0.

        While the fingers move, the force is that from before the motion. After an error of the hand the opening is
        unknown, until the hand can be read again.
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
                self._changed.notify_all()

    def close(self) -> None:
        """End the threads; the fingers stay at their position."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(timeout=2.0)

    # --- the fingers ----------------------------------------------------------------------------------------------

    def _move_newest(self) -> None:
        """Move the fingers to the newest target until the hand is closed."""
        while True:
            with self._changed:
                self._is_moving = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._is_new or self._closing)
                if self._closing:
                    return
                target, self._is_new, self._is_moving = self._target, False, True
                self._changed.notify_all()
            try:
                self._move_fingers(*target)
            except self._sdk_errors as error:
                self._note_error(error)
            else:
                self._applied_force = target[1]

    def _move_fingers(self, opening: float, force: float) -> None:
        """Move or grasp; a grasp succeeds at any width between the target and the present width of the fingers.

        The hand compares strictly: the tolerance exceeds the present width, at which the fingers may touch the object.
        """
        width, tolerance = 2.0 * opening, 2.0 * (self._last_opening + MIN_OPENING_CHANGE)
        if opening < self._last_opening - MIN_OPENING_CHANGE and force > 0.0:
            self._gripper.grasp(width, FINGER_SPEED, force, width, tolerance)
        else:
            self._gripper.move(width, FINGER_SPEED)

    # --- the state ------------------------------------------------------------------------------------------------

    def _read(self) -> None:
        """Read the hand until it is closed."""
        while True:
            with self._changed:
                if not self._closing:
                    self._changed.wait(MOVING_POLL_INTERVAL_S if self._is_moving else POLL_INTERVAL_S)
                if self._closing:
                    return
                is_moving = self._is_moving
            try:
                state = self._gripper.read_once()
            except self._sdk_errors as error:
                self._note_error(error)
                continue
            self._last_opening = 0.5 * float(state.width)
            force = self._applied_force if state.is_grasped else 0.0
            self._measured = (self._last_opening, self._measured[1] if is_moving or self._is_moving else force)

    def _note_error(self, error: Exception) -> None:
        self._measured, self._fault = (None, 0.0), f"hand: {error}"
