"""The safety filter on a target: a `SafetyFilter` whose steps run on a microcontroller behind a link."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from secrets import token_bytes
from tempfile import TemporaryDirectory
from typing import cast

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import Kernel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter, SupervisedTick
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.target.boards import find_board
from dualbrain.safety.target.build import KEY_BYTES, Firmware, build_firmware
from dualbrain.safety.target.emulated_board import EmulatedBoard
from dualbrain.safety.target.robot_tables import robot_tables_hash
from dualbrain.safety.target.session import TargetSession
from dualbrain.safety.target.target_kernel import TargetKernel


class TargetFilter(SafetyFilter):
    """A filter whose steps, and a second supervisor, run on a target; the host's kernel computes the same bits.

    The target decides by itself: it takes the conditions of each tick, adds its own, and switches the drive. A target
    that is lost, or a result with other bits, stops the robot.
    """

    def __init__(
        self,
        robot_model: RobotModel,
        config: FilterConfig,
        session: TargetSession,
        *,
        obstacles: Sequence[Obstacle] = (),
    ) -> None:
        """A filter on the target of `session`, which must have the tables of this robot and configuration.

        Raises:
            ConfigurationError: as `SafetyFilter`.
            GeometryError: an obstacle is not usable.
        """
        super().__init__(robot_model, config)
        self.target = TargetKernel(self._kernel, session, robot_model, config)
        self._kernel = cast(Kernel, self.target)
        self._step = self.target.step
        self._set_fixed_obstacles(obstacles)

    def supervise(self, tick: SupervisedTick) -> None:
        """Pass the tick to the target, which decides on a standstill and on a stop by itself."""
        self.target.supervise(tick.now, tick.stamp, tick.conditions, yielding=tick.yielding, action=tick.action)

    def target_conditions(self) -> int:
        """`Condition` bits that the target adds: its own stop, or its loss."""
        return self.target.conditions()

    def describe_target(self) -> str:
        """The board, the steps that both channels computed, and those with different bits."""
        target = self.target
        lost = f"; lost: {target.lost}" if target.lost else ""
        return (
            f"{target.board}: {target.steps} steps on target and host, {target.differences} with different bits{lost}"
        )


class EmulatedTarget:
    """An emulated board with the firmware of one robot, built for it with a new key. Use it as a context manager."""

    def __init__(
        self,
        board: str,
        robot_model: RobotModel,
        config: FilterConfig,
        *,
        toolchain: str = "zig",
        link: str = "mailbox",
        profile: str = "full",
    ) -> None:
        """Build the firmware, and start the board.

        Raises:
            UnknownNameError: there is no such board or profile.
            ConfigurationError: the toolchain or the emulator is missing, or the robot does not fit a target.
        """
        self._config, self._robot_model = config, robot_model
        found, key = find_board(board), token_bytes(KEY_BYTES)
        with ExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="dualbrain-firmware-")))
            firmware = Firmware(board=found, key=key, toolchain=toolchain, link=link, profile=profile)
            self.board = stack.enter_context(
                EmulatedBoard(found, build_firmware(firmware, robot_model, config, folder), link=link)
            )
            self.session = TargetSession(self.board.link, key, robot_tables_hash(robot_model, config))
            self._open = stack.pop_all()

    def filter(self, obstacles: Sequence[Obstacle] = ()) -> TargetFilter:
        """The filter on this target, with permanent `obstacles`."""
        return TargetFilter(self._robot_model, self._config, self.session, obstacles=obstacles)

    def __enter__(self) -> EmulatedTarget:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
