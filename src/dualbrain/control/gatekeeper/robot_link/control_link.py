"""The robot's end of the link to a control thread: a packet for each joint state, and one for each command.

The form of the packets is that of `kernel/realtime/drivers/dbk_packet_driver.h`, which is the other end.
"""

from __future__ import annotations

import socket
import struct
from math import isfinite, nan

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket
from dualbrain.robots.interface import Array, Command, RobotState

STATE_PACKET, COMMAND_PACKET = 0x31534244, 0x31434244
_STATE_HEAD = struct.Struct("=IIQQdII")
_COMMAND_HEAD = struct.Struct("=IIQII")


class ThreadCommand(msgspec.Struct, frozen=True):
    """A command of tick `tick`: joint velocities u (n,) [rad/s], and whether the drive should be on."""

    tick: int
    drive: bool
    u: Array


class Received(msgspec.Struct, frozen=True):
    """The newest command, and whether the drive is to be switched on or off (None: it stays as it is)."""

    command: ThreadCommand
    switched: bool | None


def encode_state(state: RobotState) -> bytes:
    """The packet of a joint state; a stamp that is not finite or before 0 s counts as 0 s, and is then an old one."""
    n, desired = len(state.q), ()
    if state.desired_v is not None and state.desired_a is not None:
        desired = (state.desired_v, state.desired_a)
    head = _STATE_HEAD.pack(
        STATE_PACKET,
        n,
        max(0, state.sequence),
        max(0, round(state.stamp * 1e6)) if isfinite(state.stamp) else 0,
        nan if state.opening is None else state.opening,
        state.drive_enabled,
        bool(desired),
    )
    return head + np.concatenate((state.q, state.v, *desired), dtype=float).tobytes()


def decode_command(data: bytes) -> ThreadCommand:
    """The command in a packet.

    Raises:
        DecodeError: the packet has another form.
    """
    if len(data) < _COMMAND_HEAD.size:
        raise msgspec.DecodeError("a command that is too short")
    kind, n, tick, drive, _ = _COMMAND_HEAD.unpack_from(data)
    if kind != COMMAND_PACKET or len(data) != _COMMAND_HEAD.size + 8 * n:
        raise msgspec.DecodeError("a packet that is not a command")
    return ThreadCommand(tick, bool(drive), np.frombuffer(data, float, n, _COMMAND_HEAD.size).copy())


class ControlLink:
    """Sends joint states to a control thread, and receives its commands.

    The thread commands joint velocities and the drive. The gripper belongs to the program above it, whose commands
    arrive on the other link; before the first of them, no command is complete.
    """

    def __init__(self, link: socket.socket) -> None:
        """Take ownership of the socket `link`."""
        self._socket: PacketSocket[ThreadCommand] = PacketSocket(link, decode_command)
        self._gripper: tuple[float, float] | None = None
        self._drive = False

    def send_state(self, state: RobotState) -> None:
        """Send a joint state, which is lost if the thread does not receive."""
        self._socket.send_bytes(encode_state(state))

    def set_gripper(self, command: Command) -> None:
        """Keep the opening and the force of `command`; its joint velocities are those before the thread's filter."""
        self._gripper = (command.opening, command.force)

    def receive(self) -> Received | MalformedPacket | None:
        """All commands that have arrived: the newest one, and whether they switch the drive; None if there is none."""
        newest: ThreadCommand | None = None
        switched: bool | None = None
        while (packet := self._socket.receive()) is not None:
            if isinstance(packet, MalformedPacket):
                return packet
            if packet.drive != self._drive:
                self._drive = switched = packet.drive
            newest = packet
        return None if newest is None else Received(newest, switched)

    def wait(self, seconds: float) -> bool:
        """Wait for a command, at most `seconds`; returns whether one arrived."""
        return self._socket.wait(seconds)

    def complete(self, command: ThreadCommand) -> Command | None:
        """The command with the gripper's part, None before that has arrived."""
        return None if self._gripper is None else Command(command.u, *self._gripper)


def inherited_links(arguments: list[str]) -> tuple[socket.socket, ControlLink | None]:
    """The link to the gatekeeper, and the one to its control thread if it has one; `arguments` number the sockets."""
    link, *control = (socket.socket(fileno=int(number)) for number in arguments)
    return link, ControlLink(control[0]) if control else None
