"""A host process that moves an arm with a target and is killed, and the motion of the arm until its drive is off."""

from __future__ import annotations

import mmap
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SupervisedTick
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.target.frames import decode_frame
from dualbrain.safety.target.link import MailboxLink
from dualbrain.safety.target.messages import CycleReply, Message, parse_cycle_reply
from dualbrain.safety.target.session import TargetSession
from dualbrain.safety.target.target_filter import TargetFilter

Array = NDArray[np.float64]
STALE_S = 0.05
"""The target brakes this time after the last cycle [s]; until then the drive keeps the last control."""
DECLARED_S = 0.15
"""The target switches the drive off this time after the last cycle [s]."""
WAIT_S = 3.0
"""Longest wait for the drive [s]; an emulator on a busy machine may be slow."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """A stop after a kill: postures (k, n) [rad] by period from the last reply, controls (k, n) [rad/s], and the times.

    `off_s` is the time from the kill until the drive was off by the clock of the observer, inf if it stayed on.
    `was_on`: the drive was on when the host was killed; `cycles` are those before the kill.
    """

    path: Array
    controls: Array
    off_s: float
    was_on: bool
    cycles: int


class SharedState:
    """The newest state of the arm and its last control, in memory that survives the process that writes it."""

    def __init__(self, n: int) -> None:
        """An anonymous shared memory for `n` joints with two slots, so that a torn write loses one cycle only."""
        self._layout = Struct(f"<{2 * n}d")
        self._n, self._memory = n, mmap.mmap(-1, 8 + 2 * self._layout.size)

    def write(self, count: int, q: Array, u: Array) -> None:
        """Write the state after `count` cycles."""
        self._layout.pack_into(self._memory, 8 + count % 2 * self._layout.size, *q.tolist(), *u.tolist())
        self._memory[:8] = count.to_bytes(8, "little")

    def read(self) -> tuple[int, Array, Array]:
        """Number of cycles, posture and control of the last complete write."""
        count = int.from_bytes(self._memory[:8], "little")
        values = np.array(self._layout.unpack_from(self._memory, 8 + count % 2 * self._layout.size))
        return count, values[: self._n], values[self._n :]


def kill_host(
    link: MailboxLink,
    session: TargetSession,
    robot_model: RobotModel,
    q: Array,
    scene: Sequence[Obstacle],
    *,
    seed: int,
    after_s: float,
) -> Stop:
    """Move the arm from `q` (n,) among `scene`, kill the process after `after_s` [s], and observe the target."""
    shared = SharedState(robot_model.n)
    shared.write(0, q, np.zeros(robot_model.n))
    child = os.fork()
    if child == 0:
        try:
            _move_for_ever(session, robot_model, q, scene, shared, seed)
        finally:
            os._exit(1)
    while shared.read()[0] == 0:  # it prepares the filter
        if os.waitpid(child, os.WNOHANG) != (0, 0):
            raise ChildProcessError("the host ended before its first cycle")
        time.sleep(0.001)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    killed, was_on = time.monotonic(), link.drive_enabled
    os.waitpid(child, 0)
    replies, off_s = _observe(link, session, killed)
    cycles, q, u = shared.read()
    path, controls = _motion(robot_model, q, u, replies)
    return Stop(path=path, controls=controls, off_s=off_s, was_on=was_on, cycles=cycles)


def _move_for_ever(
    session: TargetSession, robot_model: RobotModel, q: Array, scene: Sequence[Obstacle], shared: SharedState, seed: int
) -> None:
    """The host: one cycle per period with random nominal controls; the arm follows the target's control."""
    rng, period = np.random.default_rng(seed), robot_model.period
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    safety = TargetFilter(robot_model, operating_config(robot_model), session)
    safety.observe(scene, 0.0)
    u, u_nom, started, count = np.zeros(robot_model.n), v_max, time.monotonic(), 0
    due = started + period
    while True:
        if count % 150 == 0:
            u_nom = rng.choice([-1.0, 1.0], robot_model.n) * v_max
        now = time.monotonic() - started
        safety.supervise(SupervisedTick(now=now, stamp=now, conditions=0))
        safety(q, u, u_nom, now, 0.02)
        reply = safety.target.reply
        if reply is None:
            return
        u = np.asarray(reply.u[: robot_model.n], float) * reply.drive_enabled
        q, count = q + period * u, count + 1
        shared.write(count, q, u)
        time.sleep(max(0.0, due - time.monotonic()))
        due = max(due, time.monotonic()) + period  # missed periods are skipped: the target refuses cycles in advance


def _observe(link: MailboxLink, session: TargetSession, killed: float) -> tuple[list[tuple[int, CycleReply]], float]:
    """The messages of the target until its drive is off, with their types, and the time from the kill until then."""
    replies, off_s = list[tuple[int, CycleReply]](), np.inf
    while time.monotonic() < killed + WAIT_S:
        enabled = link.drive_enabled
        off_s = off_s if enabled or off_s < np.inf else time.monotonic() - killed
        for piece in session._reader.feed(link.read(0.002)):
            frame = decode_frame(piece, session._key)
            if frame is not None and frame.type in (Message.CYCLE_REPLY, Message.OUTPUT):
                replies.append((frame.type, parse_cycle_reply(frame.payload)))
        if off_s < np.inf:
            break
    return replies, off_s


def _motion(
    robot_model: RobotModel, q: Array, u: Array, replies: Sequence[tuple[int, CycleReply]]
) -> tuple[Array, Array]:
    """Postures and controls by period: the last control until the target brakes, then its outputs."""
    n, period = robot_model.n, robot_model.period
    controls = [u]
    for kind, reply in replies:
        if kind == Message.CYCLE_REPLY:  # the answer that the killed host did not read
            controls = [np.asarray(reply.u[:n], float)]
    controls = controls * round(STALE_S / period)
    controls += [np.asarray(reply.u[:n], float) for kind, reply in replies if kind == Message.OUTPUT]
    given = np.array(controls)
    return q + period * np.cumsum(given, axis=0), given
