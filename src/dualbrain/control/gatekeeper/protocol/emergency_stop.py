"""Emergency stop over a connection of its own: it needs no key, no file and no other connection.

The command is the first frame of the connection and is sent before any reply is read. Afterwards the client
becomes an observer and waits until the gatekeeper reports the stop.
"""

from __future__ import annotations

import socket
import time
from pathlib import Path

from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Hello,
    Message,
    OperatorCommand,
    StatusReport,
    decode_message,
    encode_body,
    kind_code,
)

CONFIRMATION_TIMEOUT = 1.0
"""Longest time until the stop is reported [s]."""
RETRY_PERIOD = 0.005
"""Time between two attempts to connect [s]."""


def send_emergency_stop(path: Path, *, timeout: float = CONFIRMATION_TIMEOUT) -> str:
    """Send an emergency stop to the gatekeeper that listens at `path`; returns "" once it reports the stop.

    If its queue is full, or if it closes the connection, the next attempt follows, for `timeout` [s]. Otherwise returns
    the reason why the stop is not confirmed. Never raises: a caller that stops several robots must reach all of them.
    """
    deadline = time.monotonic() + timeout
    problem = _try_to_stop(path, deadline)
    while problem and time.monotonic() < deadline:
        time.sleep(RETRY_PERIOD)
        problem = _try_to_stop(path, deadline)
    return problem


def _try_to_stop(path: Path, deadline: float) -> str:
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.settimeout(max(RETRY_PERIOD, deadline - time.monotonic()))
            link.connect(str(path))
            link.sendall(_frames(OperatorCommand(act="estop"), Hello(principal="", proof=b"", watch=False)))
            return _wait_for_stop(link, deadline)
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        return f"no gatekeeper can be reached at {path}: {getattr(error, 'strerror', None) or error}"


def _frames(*messages: Message) -> bytes:
    return b"".join(
        encode(kind_code(message), number, encode_body(message)) for number, message in enumerate(messages, start=1)
    )


def _wait_for_stop(link: socket.socket, deadline: float) -> str:
    """Wait for a status report of the emergency stop; returns "" or the reason why there was none."""
    decoder = FrameDecoder()
    while (left := deadline - time.monotonic()) > 0.0:
        link.settimeout(left)
        try:
            data = link.recv(65536)
        except TimeoutError:
            break
        if not data:
            return "the gatekeeper closed the connection before it reported the stop"
        decoder.feed(data)
        while (frame := decoder.next_frame()) is not None:
            if isinstance(frame, BrokenStream):
                return f"the answer is not that of a gatekeeper: {frame.reason}"
            match decode_message(frame, from_client=False):
                case StatusReport(action="ESTOP" | "LOCKOUT"):
                    return ""
                case _:
                    pass
    return "the stop was sent, but the gatekeeper did not report it in time"
