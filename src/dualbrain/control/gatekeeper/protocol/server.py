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

from dualbrain.control.gatekeeper.protocol.authentication import NONCE_BYTES
from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    Message,
    RequestRefused,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.errors import ConfigurationError

MAX_CONNECTIONS = 8
BYTES_PER_TICK = 4096
FRAMES_PER_TICK = 2
"""Per peer and tick."""
MAX_FRAMES_PER_SECOND = 400
"""More than this from one peer within a second is a flood."""
MAX_UNSENT_BYTES = 512 * 1024
"""A peer that does not read what it is sent is let go [bytes]."""
BACKLOG = 16


class Connection:
    """One connection: where its frames stand, who it has proven to be, what it has not read yet."""

    def __init__(self, sock: socket.socket, number: int) -> None:
        """A stranger; `number` tells peers apart."""
        self.socket, self.number = sock, number
        self.nonce = secrets.token_bytes(NONCE_BYTES)
        self.principal, self.role, self.receives_reports = "", "stranger", False
        self.last_received_at = 0.0
        self.fault = ""
        self._decoder = FrameDecoder()
        self._sent = 0
        self._unsent = bytearray()
        self._window_start, self._frames_in_window = 0.0, 0

    def send(self, message: Message) -> None:
        """Queue a message and send what goes without waiting."""
        self._sent += 1
        self._unsent += encode(kind_code(message), self._sent, encode_body(message))
        self.flush()

    def flush(self) -> None:
        """Send what goes; a peer that does not read is at fault."""
        try:
            while self._unsent:
                del self._unsent[: self.socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            self.fault = self.fault or f"gone: {error.strerror}"
        if len(self._unsent) > MAX_UNSENT_BYTES:
            self.fault = self.fault or "does not read what it is sent"

    def receive(self, now: float) -> list[tuple[int, Message]]:
        """Up to the tick's budget of messages with their sequence numbers; sets `fault` when something is wrong."""
        if self._decoder.n_buffered < BYTES_PER_TICK:
            self._read_socket()
        heard: list[tuple[int, Message]] = []
        while len(heard) < FRAMES_PER_TICK:
            frame = self._decoder.next_frame()
            if frame is None:
                break
            message = (
                f"broken stream: {frame.reason}"
                if isinstance(frame, BrokenStream)
                else decode_message(frame, from_client=True)
            )
            if isinstance(frame, BrokenStream) or isinstance(message, str):
                self.fault = self.fault or str(message)
                break
            if self._exceeds_rate_limit(now):
                self.fault = "flood"
                break
            heard.append((frame.sequence, message))
        if heard:
            self.last_received_at = now
        return heard

    def close(self) -> None:
        """Hang up."""
        self.socket.close()

    def _read_socket(self) -> None:
        try:
            data = self.socket.recv(BYTES_PER_TICK)
        except BlockingIOError:
            return
        except OSError as error:
            self.fault = self.fault or f"gone: {error.strerror}"
            return
        if data:
            self._decoder.feed(data)
        elif not self._decoder.n_buffered:
            self.fault = self.fault or "gone"

    def _exceeds_rate_limit(self, now: float) -> bool:
        if now - self._window_start >= 1.0:
            self._window_start, self._frames_in_window = now, 0
        self._frames_in_window += 1
        return self._frames_in_window > MAX_FRAMES_PER_SECOND


class SocketServer:
    """The listening socket and all who came in."""

    def __init__(self, path: Path) -> None:
        """Listen at `path` (mode 0600); raises `InvalidSetup` if somebody already does, or the path is too long."""
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        if path.exists():
            _remove_stale_socket(path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o177)
        try:
            self._listener.bind(str(path))
        except OSError as error:
            raise ConfigurationError(
                "socket", got=error.strerror, allowed="a path of up to 107 bytes", fix=str(path)
            ) from error
        finally:
            os.umask(before)
        os.chmod(path, 0o600)
        self._listener.listen(BACKLOG)
        self._listener.setblocking(False)
        self.connections: list[Connection] = []
        self._n_accepted = self._first_index = 0

    def receive(self, now: float) -> Iterator[tuple[Connection, int, Message]]:
        """Everything that fits this tick's budget, each peer in turn; `now` [s] is a monotonic clock."""
        self._accept_connection(now)
        if not self.connections:
            return
        self._first_index = (self._first_index + 1) % len(self.connections)
        for peer in [*self.connections[self._first_index :], *self.connections[: self._first_index]]:
            for sequence, message in peer.receive(now):
                yield peer, sequence, message

    def failed_connections(self) -> list[Connection]:
        """Peers that are gone or have broken a rule; they are hung up and forgotten with this call."""
        wrong = [peer for peer in self.connections if peer.fault]
        for peer in wrong:
            if not peer.fault.startswith("gone"):
                peer.send(RequestRefused(peer.fault))
            peer.close()
            self.connections.remove(peer)
        return wrong

    def broadcast(self, message: Message) -> None:
        """Say something to all who watch."""
        for peer in self.connections:
            if peer.receives_reports:
                peer.send(message)

    def flush(self) -> None:
        """Send on what could not be sent before."""
        for peer in self.connections:
            peer.flush()

    def close(self) -> None:
        """Hang up on everybody and remove the socket."""
        for peer in self.connections:
            peer.close()
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _make_room(self) -> bool:
        """Whether there is room, made if need be by letting the oldest go who neither commands nor operates."""
        if len(self.connections) < MAX_CONNECTIONS:
            return True
        idle = next((peer for peer in self.connections if peer.role in ("stranger", "observer")), None)
        if idle is None:
            return False
        idle.close()
        self.connections.remove(idle)
        return True

    def _accept_connection(self, now: float) -> None:
        """At most one newcomer a tick, of our own user, while there is room."""
        try:
            link, _ = self._listener.accept()
        except (BlockingIOError, InterruptedError):
            return
        link.setblocking(False)
        if _peer_uid(link) != os.getuid() or not self._make_room():
            link.close()
            return
        self._n_accepted += 1
        peer = Connection(link, self._n_accepted)
        peer.last_received_at = now
        self.connections.append(peer)
        peer.send(Challenge(peer.nonce))


def _peer_uid(link: socket.socket) -> int:
    """The user on the other side, as the kernel knows it."""
    size = 12
    _, user, _ = unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return user


def is_listening(path: Path) -> bool:
    """Whether somebody listens at `path`: a gatekeeper that was killed leaves a socket at which nobody does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        return probe.connect_ex(str(path)) == 0


def _remove_stale_socket(path: Path) -> None:
    """Remove a socket that nobody listens at; refuse one that somebody does."""
    if is_listening(path):
        raise ConfigurationError("socket", got="a gatekeeper that runs", allowed="a path of its own", fix=str(path))
    path.unlink()
