"""What goes over the wire between the gatekeeper and the robot: one packet a message, joint states at the robot's beat.

The simulated robot is a process of its own, as a real one is a machine of its own: it goes on when the gatekeeper dies,
and its own watchdog then switches its drive off.
"""

from __future__ import annotations

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.records import Scene
from dualbrain.robots.interface import RobotState


class Packet(msgspec.Struct, frozen=True, array_like=True):
    """Root of the packets."""


class Write(Packet, frozen=True, tag=1):
    """Joint velocity [rad/s], opening [m each], grip force [N]."""

    u: tuple[float, ...]
    opening: float
    force: float


class Switch(Packet, frozen=True, tag=2):
    """Drive on or off."""

    on: bool


class Allow(Packet, frozen=True, tag=3):
    """For the monitor: the phase that runs, and what it is about."""

    phase: str
    roles: dict[str, str | None]


class Begin(Packet, frozen=True, tag=4):
    """For the referee: the contract that was accepted."""

    contract: Contract


class Quit(Packet, frozen=True, tag=6):
    """The robot may be switched off."""


class State(Packet, frozen=True, tag=7):
    """A joint state as `RobotState`."""

    stamp: float
    sequence: int
    q: tuple[float, ...]
    v: tuple[float, ...]
    opening: float
    forces: tuple[float, float]
    driven: bool

    @classmethod
    def of(cls, state: RobotState) -> State:
        """`state` as it goes over the wire."""
        q, v = tuple(state.q.tolist()), tuple(state.v.tolist())
        return cls(state.stamp, state.sequence, q, v, state.opening, state.finger_forces, state.drive_enabled)


class Seen(Packet, frozen=True, tag=8):
    """A perceived scene."""

    scene: Scene


ToRobot = Write | Switch | Allow | Begin | Quit
FromRobot = State | Seen
PACKET = 256 * 1024
"""Longest packet [bytes]."""

encode = msgspec.msgpack.Encoder().encode
_to_robot: msgspec.msgpack.Decoder[ToRobot] = msgspec.msgpack.Decoder(ToRobot)
_from_robot: msgspec.msgpack.Decoder[FromRobot] = msgspec.msgpack.Decoder(FromRobot)
to_robot, from_robot = _to_robot.decode, _from_robot.decode
