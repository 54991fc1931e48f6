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
from dualbrain.errors import UNREADABLE

BUFFER = 1 << 20
"""How much may be on its way [bytes]."""
P = TypeVar("P", bound=packets.Packet)


class Rubbish(msgspec.Struct, frozen=True):
    """What came is no packet; why."""

    reason: str


class Wire(Generic[P]):
    """An end at which packets of kind `P` are heard; `open` until the other end is gone."""

    def __init__(self, link: socket.socket, decode: Callable[[bytes], P]) -> None:
        """Take over `link`."""
        link.setblocking(False)
        self._link, self._decode, self.open = link, decode, True

    def send(self, packet: packets.Packet) -> None:
        """A packet that does not go at once is lost, as on a real bus; the robot's watchdog counts them."""
        if not self.open:
            return
        try:
            self._link.send(packets.encode(packet))
        except BlockingIOError:
            pass
        except OSError:
            self.open = False

    def hear(self) -> P | Rubbish | None:
        """The next packet that has come; None if there is none, or the wire has been closed."""
        if not self.open:
            return None
        try:
            data = self._link.recv(packets.PACKET)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.open = False
            return None
        try:
            return self._decode(data)
        except UNREADABLE as error:
            return Rubbish(str(error))

    def wait(self, seconds: float) -> bool:
        """Until something has come, at most `seconds`; False if nothing has. Without the other end it just waits."""
        if self.open:
            return bool(select.select((self._link,), (), (), seconds)[0])
        time.sleep(seconds)
        return False

    def close(self) -> None:
        """Hang up."""
        self.open = False
        self._link.close()


def pair() -> tuple[socket.socket, socket.socket]:
    """Both ends of a new wire."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
    return ends
