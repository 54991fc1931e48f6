"""The door: a Unix socket that only its owner can open, read a little in every tick, without ever waiting.

Each tick every peer gets the same small budget of bytes and frames, in turn. A peer that sends more frames a second
than it may is shut out; what it had sent is thrown away. So a flood costs a tick a bounded time, and memory is bounded.
"""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path
from struct import unpack

from dualbrain.control.gatekeeper.protocol.authentication import NONCE
from dualbrain.control.gatekeeper.protocol.frames import Broken, Decoder, encode
from dualbrain.control.gatekeeper.protocol.messages import Challenge, Message, Refused, encode_body, kind_of, read
from dualbrain.errors import InvalidSetup

MOST_PEERS = 8
BYTES_A_TICK = 4096
FRAMES_A_TICK = 2
"""Per peer and tick."""
FRAMES_A_SECOND = 400
"""More than this from one peer within a second is a flood."""
MOST_UNSENT = 512 * 1024
"""A peer that does not read what it is sent is let go [bytes]."""
BACKLOG = 16


class Peer:
    """One connection: where its frames stand, who it has proven to be, what it has not read yet."""

    def __init__(self, link: socket.socket, number: int) -> None:
        """A stranger; `number` tells peers apart."""
        self.link, self.number = link, number
        self.nonce = secrets.token_bytes(NONCE)
        self.principal, self.role, self.watches = "", "stranger", False
        self.heard = 0.0
        self.fault = ""
        self._decoder = Decoder()
        self._sent = 0
        self._unsent = bytearray()
        self._second, self._count = 0.0, 0

    def say(self, message: Message) -> None:
        """Queue a message and send what goes without waiting."""
        self._sent += 1
        self._unsent += encode(kind_of(message), self._sent, encode_body(message))
        self.flush()

    def flush(self) -> None:
        """Send what goes; a peer that does not read is at fault."""
        try:
            while self._unsent:
                del self._unsent[: self.link.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            self.fault = self.fault or f"gone: {error.strerror}"
        if len(self._unsent) > MOST_UNSENT:
            self.fault = self.fault or "does not read what it is sent"

    def hear(self, now: float) -> list[tuple[int, Message]]:
        """Up to the tick's budget of messages with their sequence numbers; sets `fault` when something is wrong."""
        if self._decoder.waiting < BYTES_A_TICK:
            self._receive()
        heard: list[tuple[int, Message]] = []
        while len(heard) < FRAMES_A_TICK:
            frame = self._decoder.next()
            if frame is None:
                break
            message = f"broken stream: {frame.reason}" if isinstance(frame, Broken) else read(frame, upward=True)
            if isinstance(frame, Broken) or isinstance(message, str):
                self.fault = self.fault or str(message)
                break
            if self._floods(now):
                self.fault = "flood"
                break
            heard.append((frame.sequence, message))
        if heard:
            self.heard = now
        return heard

    def close(self) -> None:
        """Hang up."""
        self.link.close()

    def _receive(self) -> None:
        try:
            data = self.link.recv(BYTES_A_TICK)
        except BlockingIOError:
            return
        except OSError as error:
            self.fault = self.fault or f"gone: {error.strerror}"
            return
        if data:
            self._decoder.feed(data)
        elif not self._decoder.waiting:
            self.fault = self.fault or "gone"

    def _floods(self, now: float) -> bool:
        if now - self._second >= 1.0:
            self._second, self._count = now, 0
        self._count += 1
        return self._count > FRAMES_A_SECOND


class Door:
    """The listening socket and all who came in."""

    def __init__(self, path: Path) -> None:
        """Listen at `path` (mode 0600); raises `InvalidSetup` if somebody already does, or the path is too long."""
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        if path.exists():
            _remove_dead(path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o177)
        try:
            self._listener.bind(str(path))
        except OSError as error:
            raise InvalidSetup(
                "socket", got=error.strerror, allowed="a path of up to 107 bytes", fix=str(path)
            ) from error
        finally:
            os.umask(before)
        os.chmod(path, 0o600)
        self._listener.listen(BACKLOG)
        self._listener.setblocking(False)
        self.peers: list[Peer] = []
        self._count = self._turn = 0

    def hear(self, now: float) -> Iterator[tuple[Peer, int, Message]]:
        """Everything that fits this tick's budget, each peer in turn; `now` [s] is a monotonic clock."""
        self._admit(now)
        if not self.peers:
            return
        self._turn = (self._turn + 1) % len(self.peers)
        for peer in [*self.peers[self._turn :], *self.peers[: self._turn]]:
            for sequence, message in peer.hear(now):
                yield peer, sequence, message

    def faulty(self) -> list[Peer]:
        """Peers that are gone or have broken a rule; they are hung up and forgotten with this call."""
        wrong = [peer for peer in self.peers if peer.fault]
        for peer in wrong:
            if not peer.fault.startswith("gone"):
                peer.say(Refused(peer.fault))
            peer.close()
            self.peers.remove(peer)
        return wrong

    def tell(self, message: Message) -> None:
        """Say something to all who watch."""
        for peer in self.peers:
            if peer.watches:
                peer.say(message)

    def flush(self) -> None:
        """Send on what could not be sent before."""
        for peer in self.peers:
            peer.flush()

    def close(self) -> None:
        """Hang up on everybody and remove the socket."""
        for peer in self.peers:
            peer.close()
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _room(self) -> bool:
        """Whether there is room, made if need be by letting the oldest go who neither commands nor operates."""
        if len(self.peers) < MOST_PEERS:
            return True
        idle = next((peer for peer in self.peers if peer.role in ("stranger", "observer")), None)
        if idle is None:
            return False
        idle.close()
        self.peers.remove(idle)
        return True

    def _admit(self, now: float) -> None:
        """At most one newcomer a tick, of our own user, while there is room."""
        try:
            link, _ = self._listener.accept()
        except (BlockingIOError, InterruptedError):
            return
        link.setblocking(False)
        if _user(link) != os.getuid() or not self._room():
            link.close()
            return
        self._count += 1
        peer = Peer(link, self._count)
        peer.heard = now
        self.peers.append(peer)
        peer.say(Challenge(peer.nonce))


def _user(link: socket.socket) -> int:
    """The user on the other side, as the kernel knows it."""
    size = 12
    _, user, _ = unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return user


def listens(path: Path) -> bool:
    """Whether somebody listens at `path`: a gatekeeper that was killed leaves a socket at which nobody does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        return probe.connect_ex(str(path)) == 0


def _remove_dead(path: Path) -> None:
    """Remove a socket that nobody listens at; refuse one that somebody does."""
    if listens(path):
        raise InvalidSetup("socket", got="a gatekeeper that runs", allowed="a path of its own", fix=str(path))
    path.unlink()
