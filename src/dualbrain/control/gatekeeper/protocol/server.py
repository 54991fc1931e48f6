"""Non-blocking Unix-domain socket server (mode 0600, same user only).

In each tick the server reads a bounded number of bytes and frames from every connection, in turn, and then accepts a
bounded number of clients, from which it reads at once. It closes a connection that exceeds the rate limit and drops its
unread frames. A flood therefore costs a bounded time per tick, and bounded memory.
"""

from __future__ import annotations

import errno
import os
import secrets
import select
import socket
import stat
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
from dualbrain.core.storage.private_files import create_private_folder, describe_kind
from dualbrain.errors import ConfigurationError

MAX_CONNECTIONS, MAX_AUTHENTICATED = 12, 8
"""Largest number of connections, and of those with the role of commander or operator. The others can be replaced, so
that an emergency stop always finds room."""
BYTES_PER_TICK = 4096
"""Bytes that are read per connection and tick."""
FRAMES_PER_TICK = 2
"""Frames that are processed per connection and tick."""
MAX_FRAMES_PER_SECOND = 400
"""Rate limit of a connection; more frames within a second are a flood."""
MAX_UNSENT_BYTES = 512 * 1024
"""Unsent data [bytes] beyond which a connection is closed."""
BACKLOG = 128
"""Clients that may wait for `accept`; a client of a longer queue is refused."""
ACCEPTED_PER_TICK = MAX_CONNECTIONS - MAX_AUTHENTICATED
"""Connections that are accepted per tick. All are read in the same tick, before a later client can replace them."""
KEPT_OBSERVERS = 6
"""Observers beyond this number are replaced before connections that have not authenticated themselves."""
REPLACEABLE_ROLES = ("stranger", "observer")
"""Roles without a key."""
ANOTHER_PATH = "Name another path with --socket"
"""Remedy if the path of the socket is taken."""
DISCONNECTED, FLOOD = "disconnected", "flood"
"""Beginning of the fault of a connection that the client ended, and the fault of one that exceeded the rate limit."""


class Connection:
    """One connection: role and principal, decoder of received frames, and data that is not sent yet.

    `fault` is the reason why the connection ended or must be closed, "" if there is none. `was_read` is whether it
    had a turn since it was accepted.
    """

    def __init__(self, sock: socket.socket, number: int) -> None:
        """Start without authentication; `number` identifies the connection."""
        self.socket, self.number = sock, number
        self.nonce = secrets.token_bytes(NONCE_BYTES)
        self.principal, self.role, self.receives_reports = "", "stranger", False
        self.last_received_at = 0.0
        self.fault, self.was_read = "", False
        self._decoder = FrameDecoder()
        self._sent = 0
        self._unsent = bytearray()
        self._window_start, self._frames_in_window = 0.0, 0

    @property
    def has_frame(self) -> bool:
        """Whether a complete frame has been received and not returned yet."""
        return self._decoder.has_frame

    def send(self, message: Message) -> None:
        """Queue a message and send as much as is possible without waiting."""
        self._sent += 1
        self._unsent += encode(kind_code(message), self._sent, encode_body(message))
        self.flush()

    def flush(self) -> None:
        """Send as much as is possible without waiting; too much unsent data is a fault."""
        try:
            while self._unsent:
                del self._unsent[: self.socket.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            self.fault = self.fault or f"{DISCONNECTED}: {error.strerror}"
        if len(self._unsent) > MAX_UNSENT_BYTES:
            self.fault = self.fault or "the client does not read its messages"

    def receive(self, now: float) -> list[tuple[int, Message]]:
        """Received messages with their sequence numbers, within the budget of a tick; sets `fault` after an error."""
        if not self._decoder.has_frame:  # a frame of any length becomes complete; at most one frame is kept
            self._read_socket()
        received: list[tuple[int, Message]] = []
        while len(received) < FRAMES_PER_TICK:
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
                self.fault = FLOOD
                break
            received.append((frame.sequence, message))
        if received:
            self.last_received_at = now
        return received

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()

    def _read_socket(self) -> None:
        try:
            data = self.socket.recv(BYTES_PER_TICK)
        except BlockingIOError:
            return
        except OSError as error:
            self.fault = self.fault or f"{DISCONNECTED}: {error.strerror}"
            return
        if data:
            self._decoder.feed(data)
        else:
            self.fault = self.fault or DISCONNECTED

    def _exceeds_rate_limit(self, now: float) -> bool:
        if now - self._window_start >= 1.0:
            self._window_start, self._frames_in_window = now, 0
        self._frames_in_window += 1
        return self._frames_in_window > MAX_FRAMES_PER_SECOND


class SocketServer:
    """The listening socket and its connections."""

    def __init__(self, path: Path) -> None:
        """Listen at `path` (mode 0600).

        A socket of this user at which no process listens is replaced. Raises `ConfigurationError` if another process
        listens there, if anything else is there (which is left as it is), or if the path is too long.
        """
        self.path = path
        create_private_folder(path.parent)
        _remove_stale_socket(path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o177)
        try:
            self._listener.bind(str(path))
            self._identity = _file_identity(path)
        except OSError as error:
            self._listener.close()
            raise ConfigurationError.stating(
                f"The socket {path} cannot be created: {error.strerror or error}.",
                fix="Name a path of up to 107 bytes in a writable folder with --socket.",
            ) from error
        finally:
            os.umask(before)
        os.chmod(path, 0o600)
        self._listener.listen(BACKLOG)
        self._listener.setblocking(False)
        self.connections: list[Connection] = []
        self._readable = select.poll()
        self._readable.register(self._listener, select.POLLIN)
        self._n_accepted = self._first_index = 0

    def receive(self, now: float) -> Iterator[tuple[Connection, int, Message]]:
        """Messages of all connections in turn, within the budget of a tick; `now` [s] is a monotonic clock.

        Clients that wait are accepted after every connection had its turn, so that none is replaced unread.
        """
        readable = self._poll()
        self._first_index = (self._first_index + 1) % max(1, len(self.connections))
        in_turn = [*self.connections[self._first_index :], *self.connections[: self._first_index]]
        yield from self._read(in_turn, readable, now)
        if self._listener.fileno() in readable and (accepted := self._accept_waiting(now)):
            yield from self._read(accepted, self._poll(), now)

    def failed_connections(self) -> list[Connection]:
        """Close, remove and return the connections that have a fault."""
        failed = [connection for connection in self.connections if connection.fault]
        for connection in failed:
            if not connection.fault.startswith(DISCONNECTED):
                connection.send(RequestRefused(connection.fault))
            self._remove(connection)
        return failed

    def broadcast(self, message: Message) -> None:
        """Send a message to all connections that requested reports."""
        for connection in self.connections:
            if connection.receives_reports:
                connection.send(message)

    def flush(self) -> None:
        """Send data that could not be sent before."""
        for connection in self.connections:
            connection.flush()

    def close(self) -> None:
        """Close all connections, and remove the socket unless another file is at its path by now."""
        for connection in self.connections:
            connection.close()
        is_own = _file_identity(self.path) == self._identity
        self._listener.close()
        if is_own:
            self.path.unlink(missing_ok=True)

    @property
    def is_full(self) -> bool:
        """Whether there are as many commanders and operators as are allowed."""
        return sum(connection.role not in REPLACEABLE_ROLES for connection in self.connections) >= MAX_AUTHENTICATED

    def _poll(self) -> set[int]:
        """The descriptors that can be read; a poll takes a quarter of the time of one failed call."""
        return {descriptor for descriptor, _ in self._readable.poll(0)}

    def _read(
        self, connections: list[Connection], readable: set[int], now: float
    ) -> Iterator[tuple[Connection, int, Message]]:
        for connection in connections:
            connection.was_read = True
            if connection.has_frame or connection.socket.fileno() in readable:
                for sequence, message in connection.receive(now):
                    yield connection, sequence, message

    def _replaceable(self) -> list[Connection]:
        """Connections that may be closed to make room: surplus observers, strangers, other observers, the oldest first.

        A connection that was not read since it was accepted, or whose fault was not reported, may not.
        """
        strangers, observers = (
            [one for one in self.connections if one.role == role and one.was_read and not one.fault]
            for role in REPLACEABLE_ROLES
        )
        n_surplus = max(0, len(observers) - KEPT_OBSERVERS)
        return [*observers[:n_surplus], *strangers, *observers[n_surplus:]]

    def _remove(self, connection: Connection) -> None:
        self._readable.unregister(connection.socket)
        connection.close()
        self.connections.remove(connection)

    def _accept_waiting(self, now: float) -> list[Connection]:
        """Accept clients of the same user that wait, within the budget of a tick and while there is room."""
        accepted: list[Connection] = []
        for _ in range(ACCEPTED_PER_TICK):
            replaceable = self._replaceable()
            if len(self.connections) >= MAX_CONNECTIONS and not replaceable:
                break
            try:
                client, _ = self._listener.accept()
            except OSError:  # no client waits, or it has gone, or no file handle is left
                break
            if _peer_uid(client) != os.getuid():
                client.close()
                continue
            if len(self.connections) >= MAX_CONNECTIONS:
                self._remove(replaceable[0])
            accepted.append(self._add(client, now))
        return accepted

    def _add(self, accepted: socket.socket, now: float) -> Connection:
        """Add an accepted connection, and send it the challenge."""
        accepted.setblocking(False)
        self._n_accepted += 1
        connection = Connection(accepted, self._n_accepted)
        connection.last_received_at = now
        self.connections.append(connection)
        self._readable.register(accepted, select.POLLIN)
        connection.send(Challenge(connection.nonce))
        return connection


def _peer_uid(accepted: socket.socket) -> int:
    """The user id of the client, as the operating system reports it."""
    size = 12
    _, user, _ = unpack("3i", accepted.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
    return user


def is_listening(path: Path) -> bool:
    """Whether a process listens at `path`; a killed gatekeeper leaves a socket at which no process listens."""
    return _probe(path) in (0, errno.EAGAIN)


def _probe(path: Path) -> int:
    """The error number of a connection to `path`: 0 if it was accepted, EAGAIN if the listener is busy."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            return probe.connect_ex(str(path))
        except OSError:  # a path that is too long for a socket
            return errno.ENAMETOOLONG


def _file_identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of the file at `path`, not of the target of a link; None if there is none."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _remove_stale_socket(path: Path) -> None:
    """Remove a socket of this user at which no process listens; raise `ConfigurationError` for anything else."""
    try:
        found = path.lstat()
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigurationError.stating(
            f"The socket {path} cannot be created: {error.strerror}.", fix=f"{ANOTHER_PATH}."
        ) from error
    if not stat.S_ISSOCK(found.st_mode):
        raise ConfigurationError.stating(
            f"{path} is {describe_kind(found.st_mode)} and not a socket, so it is left as it is.",
            fix="Move it away, or name another path with --socket.",
        )
    if found.st_uid != os.geteuid():
        raise ConfigurationError.stating(
            f"The socket {path} belongs to another user (user id {found.st_uid}).", fix=f"{ANOTHER_PATH}."
        )
    answer = _probe(path)
    if answer in (0, errno.EAGAIN):
        raise ConfigurationError.stating(
            f"The socket {path} is in use by a running gatekeeper.", fix="Stop it, or name another path with --socket."
        )
    if answer not in (errno.ECONNREFUSED, errno.ENOENT):
        raise ConfigurationError.stating(
            f"The socket {path} is in use by another program ({os.strerror(answer)}).", fix=f"{ANOTHER_PATH}."
        )
    if _file_identity(path) == (found.st_dev, found.st_ino):
        path.unlink()
