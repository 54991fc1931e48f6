"""The Franka hand: its calls block until the fingers have arrived, so they live on a thread of their own."""

from __future__ import annotations

from threading import Condition, Thread
from typing import Any

SPEED = 0.05
"""[m/s] of the width: what the hand's data sheet gives for each finger, halved."""
SAME = 5e-4
"""A wish nearer than this [m] to the last one is no new wish."""
LOOK_EVERY = 0.05
"""How often the hand is asked where it stands while nothing is wished [s]."""


class FrankaHand:
    """Opens with `move`, closes with `grasp`; always carries out the newest wish, one after the other."""

    def __init__(self, gripper: Any, raised: tuple[type[Exception], ...], widest: float) -> None:
        """`widest` [m each] is the opening that is wished at first; `raised` is what `gripper` may raise."""
        self._gripper, self._raised = gripper, raised
        self._seen = (0.5 * float(gripper.read_once().width), 0.0)
        self._wish, self._done = (widest, 0.0), (self._seen[0], 0.0)
        self._news, self._closing = Condition(), False
        self.fault = ""
        self._thread = Thread(target=self._work, name="franka hand", daemon=True)
        self._thread.start()

    @property
    def seen(self) -> tuple[float, float]:
        """Opening [m each], and the grip force [N] that was asked for if something is held, else 0."""
        return self._seen

    def wish(self, opening: float, force: float) -> None:
        """Where the fingers should go [m each] and how firmly they may press [N]; returns at once."""
        if abs(opening - self._wish[0]) > SAME or (force != self._wish[1] and opening < self._seen[0] - SAME):
            with self._news:
                self._wish = (opening, force)
                self._news.notify()

    def close(self) -> None:
        """End the thread; the fingers stay as they are."""
        with self._news:
            self._closing = True
            self._news.notify()
        self._thread.join(timeout=2.0)

    def _work(self) -> None:
        while True:
            with self._news:
                if not self._closing and self._wish == self._done:
                    self._news.wait(LOOK_EVERY)
                if self._closing:
                    return
                wish = self._wish
            try:
                if wish != self._done:
                    self._go(*wish)
                    self._done = wish
                state = self._gripper.read_once()
            except self._raised as error:
                self.fault, self._done = str(error), wish
                continue
            self._seen = (0.5 * float(state.width), wish[1] if state.is_grasped else 0.0)

    def _go(self, opening: float, force: float) -> None:
        """A grasp may end anywhere between closed and where the fingers stand: what is held is as wide as it is."""
        width = 2.0 * opening
        if opening < self._seen[0] - SAME and force > 0.0:
            self._gripper.grasp(width, SPEED, force, width, 2.0 * self._seen[0])
        else:
            self._gripper.move(width, SPEED)
