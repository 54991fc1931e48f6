"""The Franka hand: its calls block until the fingers have arrived, so they live on a thread of their own."""

from __future__ import annotations

from threading import Condition, Thread
from typing import Any

FINGER_SPEED = 0.05
"""[m/s] of the width: what the hand's data sheet gives for each finger, halved."""
MIN_OPENING_CHANGE = 5e-4
"""A wish nearer than this [m] to the last one is no new wish."""
POLL_INTERVAL_S = 0.05
"""How often the hand is asked where it stands while nothing is wished [s]."""


class FrankaHand:
    """Opens with `move`, closes with `grasp`; always carries out the newest wish, one after the other."""

    def __init__(self, gripper: Any, sdk_errors: tuple[type[Exception], ...], max_opening: float) -> None:
        """`widest` [m each] is the opening that is wished at first; `raised` is what `gripper` may raise."""
        self._gripper, self._sdk_errors = gripper, sdk_errors
        self._measured = (0.5 * float(gripper.read_once().width), 0.0)
        self._target, self._reached = (max_opening, 0.0), (self._measured[0], 0.0)
        self._changed, self._closing = Condition(), False
        self.fault = ""
        self._thread = Thread(target=self._run, name="franka hand", daemon=True)
        self._thread.start()

    @property
    def measured(self) -> tuple[float, float]:
        """Opening [m each], and the grip force [N] that was asked for if something is held, else 0."""
        return self._measured

    def set_target(self, opening: float, force: float) -> None:
        """Where the fingers should go [m each] and how firmly they may press [N]; returns at once."""
        if abs(opening - self._target[0]) > MIN_OPENING_CHANGE or (
            force != self._target[1] and opening < self._measured[0] - MIN_OPENING_CHANGE
        ):
            with self._changed:
                self._target = (opening, force)
                self._changed.notify()

    def close(self) -> None:
        """End the thread; the fingers stay as they are."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._closing and self._target == self._reached:
                    self._changed.wait(POLL_INTERVAL_S)
                if self._closing:
                    return
                wish = self._target
            try:
                if wish != self._reached:
                    self._move_fingers(*wish)
                    self._reached = wish
                state = self._gripper.read_once()
            except self._sdk_errors as error:
                self.fault, self._reached = str(error), wish
                continue
            self._measured = (0.5 * float(state.width), wish[1] if state.is_grasped else 0.0)

    def _move_fingers(self, opening: float, force: float) -> None:
        """A grasp may end anywhere between closed and where the fingers stand: what is held is as wide as it is."""
        width = 2.0 * opening
        if opening < self._measured[0] - MIN_OPENING_CHANGE and force > 0.0:
            self._gripper.grasp(width, FINGER_SPEED, force, width, 2.0 * self._measured[0])
        else:
            self._gripper.move(width, FINGER_SPEED)
