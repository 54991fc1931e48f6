"""The safety filter of a gatekeeper above a control thread, which filters its controls a second time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from numpy.typing import ArrayLike

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter, SupervisedTick
from dualbrain.safety.cbf.obstacles import Contact, Obstacle
from dualbrain.safety.cbf.rows import ConstraintRow
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition

PASSED_ON = int(Condition.ESTOP | Condition.ESTOP_DISAGREE)
"""Conditions that the thread holds, too. The effects of all others are in the controls and in the drive."""


class ThreadFilter(SafetyFilter):
    """Notes changes of its scene, passes buttons and the emergency stop on, and adds the thread's own conditions."""

    def __init__(
        self,
        robot_model: RobotModel,
        config: FilterConfig | None = None,
        *,
        obstacles: Sequence[Obstacle] = (),
        thread_conditions: Callable[[], int] = lambda: 0,
    ) -> None:
        """A filter as `SafetyFilter`; `thread_conditions` returns the `Condition` bits that the thread detected.

        Raises:
            ConfigurationError: as `SafetyFilter`.
            GeometryError: an obstacle is not usable.
        """
        self.scene_changed = True
        self.conditions, self.pressed = 0, 0
        self.standstill = self.stopped = False
        self._thread_conditions, self._buttons = thread_conditions, 0
        super().__init__(robot_model, config, obstacles=obstacles)

    def observe(self, obstacles: Sequence[Obstacle], stamp: float = 0.0) -> None:
        """As `SafetyFilter.observe`, which may raise."""
        self.scene_changed = True
        super().observe(obstacles, stamp)

    def permit(self, permits: Sequence[Contact]) -> None:
        """As `SafetyFilter.permit`, which may raise."""
        self.scene_changed = True
        super().permit(permits)

    def attach(self, spheres: ArrayLike, error: float) -> None:
        """As `SafetyFilter.attach`, which may raise."""
        self.scene_changed = True
        super().attach(spheres, error)

    def constrain(self, rows: Sequence[ConstraintRow]) -> None:
        """As `SafetyFilter.constrain`, which may raise."""
        self.scene_changed = True
        super().constrain(rows)

    def detach(self) -> None:
        """As `SafetyFilter.detach`."""
        self.scene_changed = True
        super().detach()

    def supervise(self, tick: SupervisedTick) -> None:
        """Note what the thread must know of a tick; a button counts when it is pressed."""
        self.standstill, self.stopped = tick.standstill, tick.stopped
        self.conditions = tick.conditions & PASSED_ON
        self.pressed |= tick.conditions & BUTTONS & ~self._buttons
        self._buttons = tick.conditions & BUTTONS

    def target_conditions(self) -> int:
        """`Condition` bits that the thread detected since the last call."""
        return self._thread_conditions()
