"""One end of the wire between gatekeeper and robot: packets leave at once or never, and come when they come.

The ends are a pair of SOCK_SEQPACKET sockets, which keep packets whole. Nothing here waits, but for `wait`.
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
"""How much may be on its way [bytes]."""
P = TypeVar("P", bound=packets.Packet)


class MalformedPacket(msgspec.Struct, frozen=True):
    """What came is no packet; why."""

    reason: str


class PacketSocket(Generic[P]):
    """An end at which packets of kind `P` are heard; `open` until the other end is gone."""

    def __init__(self, link: socket.socket, decode: Callable[[bytes], P]) -> None:
        """Take over `link`."""
        link.setblocking(False)
        self._socket, self._decode, self.is_open = link, decode, True

    def send(self, packet: packets.Packet) -> None:
        """A packet that does not go at once is lost, as on a real bus; the robot's watchdog counts them."""
        if not self.is_open:
            return
        try:
            self._socket.send(packets.encode(packet))
        except BlockingIOError:
            pass
        except OSError:
            self.is_open = False

    def receive(self) -> P | MalformedPacket | None:
        """The next packet that has come; None if there is none, or the wire has been closed."""
        if not self.is_open:
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
        """Until something has come, at most `seconds`; False if nothing has. Without the other end it just waits."""
        if self.is_open:
            return bool(select.select((self._socket,), (), (), seconds)[0])
        time.sleep(seconds)
        return False

    def close(self) -> None:
        """Hang up."""
        self.is_open = False
        self._socket.close()


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Both ends of a new wire."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    return ends
