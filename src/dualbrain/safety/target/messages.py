"""Messages between the host and a target; firmware/protocol/messages.h states types and offsets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import isnan
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

JOINTS = 8
OBSTACLE_SIZE = 132
OBSTACLES_A_FRAME = 7
OPENING_KNOWN, MOBILE, YIELDING = 1, 2, 4


class Message(IntEnum):
    """Types of messages; those of the target have the highest bit."""

    HELLO = 0x01
    SCENE_BEGIN = 0x02
    OBSTACLES = 0x03
    SCENE_END = 0x04
    PERMITS = 0x05
    HELD = 0x06
    ROWS = 0x07
    RESET = 0x08
    CYCLE = 0x09
    HELLO_REPLY = 0x81
    CYCLE_REPLY = 0x89
    OUTPUT = 0x8A


HELLO, HELLO_REPLY = Struct("<QQ"), Struct("<QQQBH15sB")
CYCLE = Struct(f"<QQQ{JOINTS}f{JOINTS}f{JOINTS}ffffI12f")
CYCLE_REPLY = Struct(f"<Q{JOINTS}f4fIIHHBBBBBBBxI")
_OBSTACLE = Struct("<3iI29f")
_COUNT, _RANGE, _PERMIT, _HELD_HEAD, _ROW = (
    Struct("<H"),
    Struct("<HH"),
    Struct("<BBHf"),
    Struct("<HHf"),
    Struct("<10fI"),
)
_RESET = Struct(f"<{2 * JOINTS}f")
Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetDescription:
    """The reply to HELLO: hashes of the robot tables and of the kernel, joints, most obstacles, board.

    Without `knows_opening` the opening of the gripper counts as unknown on the target.
    """

    nonce: int
    robot_hash: int
    kernel_hash: int
    joints: int
    max_obstacles: int
    board: str
    knows_opening: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleReply:
    """Result of one cycle on the target: control (8,) [rad/s], filter result, decision of its supervisor, drive."""

    conditions: int
    u: Float32
    delta: float
    delta_rows: float
    delta_box: float
    h_min: float
    flags: int
    refused: int
    iterations: int
    n_rows: int
    status: int
    certified: bool
    relaxed: int
    action: int
    check: int
    drive_enabled: bool
    at_standstill: bool
    step_us: int


def padded(values: Sequence[float]) -> tuple[float, ...]:
    """Joint values with zeros up to the length of the messages."""
    return (*values, *([0.0] * (JOINTS - len(values))))


def obstacle_frames(table: NDArray[np.float64], near: dict[int, tuple[float, ...]]) -> list[tuple[Message, bytes]]:
    """The messages that replace the obstacles by the rows of the kernel's table (k, 29), with `near` limits by row."""
    records = [_obstacle_record(row, near.get(i, (0.0,) * 4)) for i, row in enumerate(table.tolist())]
    frames = [(Message.SCENE_BEGIN, _COUNT.pack(len(records)))]
    for first in range(0, len(records), OBSTACLES_A_FRAME):
        part = records[first : first + OBSTACLES_A_FRAME]
        frames.append((Message.OBSTACLES, _RANGE.pack(first, len(part)) + b"".join(part)))
    return [*frames, (Message.SCENE_END, b"")]


def _obstacle_record(row: list[float], near: tuple[float, ...]) -> bytes:
    if any(map(isnan, row[:4])):  # a table that the kernel rejects
        row = [0.0] * 4 + row[4:]
    shape, flags, rank, mask, *reals = row
    return _OBSTACLE.pack(int(shape), int(flags), int(rank), int(mask), *reals, *near)


def pack_permits(permits: Sequence[tuple[int, int, float]]) -> bytes:
    """Payload of PERMITS: link, obstacle and speed [m/s] of each."""
    return _COUNT.pack(len(permits)) + b"".join(_PERMIT.pack(link, 0, other, speed) for link, other, speed in permits)


def pack_held(spheres: NDArray[np.float64], error: float) -> bytes:
    """Payload of HELD: spheres (k, 4) in the last frame, and their position error [m]."""
    return _HELD_HEAD.pack(len(spheres), 0, error) + np.asarray(spheres, "<f4").tobytes()


def pack_rows(rows: NDArray[np.float64], n: int) -> bytes:
    """Payload of ROWS: rows (k, n + 3) with a, b, h and rank."""
    body = b"".join(_ROW.pack(*padded(row[:n]), row[n], row[n + 1], int(row[n + 2])) for row in rows.tolist())
    return _RANGE.pack(len(rows), 0) + body


def pack_reset(u: Sequence[float], change: Sequence[float]) -> bytes:
    """Payload of RESET: the last control and its last change, in rad/s."""
    return _RESET.pack(*padded(u), *padded(change))


def parse_hello_reply(payload: bytes) -> TargetDescription:
    """The description of a target."""
    nonce, robot, kernel, joints, obstacles, board, opening = HELLO_REPLY.unpack(payload)
    return TargetDescription(
        nonce=nonce,
        robot_hash=robot,
        kernel_hash=kernel,
        joints=joints,
        max_obstacles=obstacles,
        board=board.rstrip(b"\0").decode("ascii", "replace"),
        knows_opening=bool(opening),
    )


def parse_cycle_reply(payload: bytes) -> CycleReply:
    """The result of a cycle."""
    values: tuple[Any, ...] = CYCLE_REPLY.unpack(payload)
    conditions, u, rest = values[0], np.array(values[1 : 1 + JOINTS], np.float32), values[1 + JOINTS :]
    delta, rows, box, h_min, flags, refused, iterations, n_rows = rest[:8]
    status, certified, relaxed, action, check, drive, standstill, step_us = rest[8:]
    return CycleReply(
        conditions=conditions,
        u=u,
        delta=delta,
        delta_rows=rows,
        delta_box=box,
        h_min=h_min,
        flags=flags,
        refused=refused,
        iterations=iterations,
        n_rows=n_rows,
        status=status,
        certified=bool(certified),
        relaxed=relaxed,
        action=action,
        check=check,
        drive_enabled=bool(drive),
        at_standstill=bool(standstill),
        step_us=step_us,
    )
