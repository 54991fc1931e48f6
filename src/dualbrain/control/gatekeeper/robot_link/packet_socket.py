"""One end of the non-blocking packet link between gatekeeper and robot.

The ends are a pair of SOCK_SEQPACKET sockets, which preserve packet boundaries. A packet that cannot be sent at once is
lost. Only `wait` blocks.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable
from typing import Generic, TypeVar

import msgspec

from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.errors import DECODE_ERRORS

SEND_BUFFER_BYTES = 1 << 20
"""Size of the send buffer [bytes]."""
P = TypeVar("P", bound=msgspec.Struct)


class MalformedPacket(msgspec.Struct, frozen=True):
    """Received data that is not a valid packet, and the `reason`."""

    reason: str


class PacketSocket(Generic[P]):
    """One end of the link, which receives packets of type `P`; `is_open` until the other end is closed."""

    def __init__(self, link: socket.socket, decode: Callable[[bytes], P]) -> None:
        """Take ownership of the socket `link`."""
        link.setblocking(False)
        self._socket, self._decode, self.is_open = link, decode, True
        self._readable = select.poll()
        self._readable.register(link, select.POLLIN)

    def send(self, packet: packets.Packet) -> None:
        """Send a packet, which is lost if the buffer is full, as on a real bus; the robot has a watchdog for that."""
        if self.is_open:
            self.send_bytes(packets.encode(packet))

    def send_bytes(self, data: bytes) -> None:
        """Send an encoded packet, which is lost if the buffer is full."""
        if not self.is_open:
            return
        try:
            self._socket.send(data)
        except BlockingIOError:
            pass
        except OSError:
            self.is_open = False

    def receive(self) -> P | MalformedPacket | None:
        """The next received packet; None if there is none or the link is closed."""
        if not (self.is_open and self._readable.poll(0)):  # a failed call of `recv` takes three times as long
            return None
        try:
            data = self._socket.recv(packets.MAX_PACKET_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.is_open = False
            return None
        try:
            return self._decode(data)
        except DECODE_ERRORS as error:
            return MalformedPacket(str(error))

    def wait(self, seconds: float) -> bool:
        """Wait for a packet, at most `seconds`; returns whether one arrived. On a closed link, wait all `seconds`."""
        if self.is_open:
            return bool(select.select((self._socket,), (), (), seconds)[0])  # `poll` waits for whole milliseconds
        time.sleep(seconds)
        return False

    def mark_closed(self) -> None:
        """Treat the link as closed, from any thread: the process at the other end has ended."""
        self.is_open = False

    def close(self) -> None:
        """Close this end."""
        self.is_open = False
        self._socket.close()


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Both ends of a new link."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    return ends
