"""Packets between the gatekeeper and the robot process; the robot sends a joint state in each of its periods.

The simulated robot is a separate process, as a real robot is a separate machine: it continues when the gatekeeper dies,
and its own watchdog then switches its drive off.
"""

from __future__ import annotations

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.records import Scene
from dualbrain.robots.interface import Array, RobotState


class Packet(msgspec.Struct, frozen=True, array_like=True):
    """Base class of the packets."""


class CommandPacket(Packet, frozen=True, tag=1):
    """Joint velocity [rad/s], opening [m each], grip force [N]."""

    u: tuple[float, ...]
    opening: float
    force: float


class DrivePacket(Packet, frozen=True, tag=2):
    """Drive on or off."""

    on: bool


class PhasePacket(Packet, frozen=True, tag=3):
    """The running phase and its objects by role, for the monitor of a simulation."""

    phase: str
    roles: dict[str, str | None]


class ContractPacket(Packet, frozen=True, tag=4):
    """The accepted contract, for the judge of a simulation."""

    contract: Contract


class ShutdownPacket(Packet, frozen=True, tag=6):
    """Request to end the robot process."""


def _numbers(values: Array | None) -> tuple[float, ...] | None:
    return None if values is None else tuple(values.tolist())


def _array(values: tuple[float, ...] | None) -> Array | None:
    return None if values is None else np.array(values)


class StatePacket(Packet, frozen=True, tag=7, kw_only=True):
    """A joint state; fields and units are those of `RobotState`."""

    stamp: float
    sequence: int
    q: tuple[float, ...]
    v: tuple[float, ...]
    opening: float | None
    forces: tuple[float, float]
    drive_enabled: bool
    torques: tuple[float, ...] | None = None
    wrench: tuple[float, ...] | None = None
    desired_v: tuple[float, ...] | None = None
    desired_a: tuple[float, ...] | None = None

    @classmethod
    def from_state(cls, state: RobotState) -> StatePacket:
        """The packet of a joint state."""
        q, v = tuple(state.q.tolist()), tuple(state.v.tolist())
        return cls(
            stamp=state.stamp,
            sequence=state.sequence,
            q=q,
            v=v,
            opening=state.opening,
            forces=state.finger_forces,
            drive_enabled=state.drive_enabled,
            torques=_numbers(state.torques),
            wrench=_numbers(state.wrench),
            desired_v=_numbers(state.desired_v),
            desired_a=_numbers(state.desired_a),
        )

    def to_robot_state(self) -> RobotState:
        """The joint state in the packet."""
        return RobotState(
            stamp=self.stamp,
            sequence=self.sequence,
            q=np.array(self.q),
            v=np.array(self.v),
            opening=self.opening,
            finger_forces=self.forces,
            drive_enabled=self.drive_enabled,
            torques=_array(self.torques),
            wrench=_array(self.wrench),
            desired_v=_array(self.desired_v),
            desired_a=_array(self.desired_a),
        )


class ScenePacket(Packet, frozen=True, tag=8):
    """A perceived scene."""

    scene: Scene


ToRobot = CommandPacket | DrivePacket | PhasePacket | ContractPacket | ShutdownPacket
FromRobot = StatePacket | ScenePacket
MAX_PACKET_BYTES = 256 * 1024
"""Longest packet [bytes]."""

encode = msgspec.msgpack.Encoder().encode
_to_robot_decoder: msgspec.msgpack.Decoder[ToRobot] = msgspec.msgpack.Decoder(ToRobot)
_from_robot_decoder: msgspec.msgpack.Decoder[FromRobot] = msgspec.msgpack.Decoder(FromRobot)
decode_to_robot, decode_from_robot = _to_robot_decoder.decode, _from_robot_decoder.decode
