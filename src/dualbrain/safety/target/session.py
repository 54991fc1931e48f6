"""A session with a target: mutual authentication, then messages with increasing sequence numbers."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable
from typing import TypeVar

from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.safety.target.frames import Frame, FrameReader, decode_frame, encode_frame, tag
from dualbrain.safety.target.link import Link
from dualbrain.safety.target.messages import (
    HELLO,
    CycleReply,
    Message,
    TargetDescription,
    parse_cycle_reply,
    parse_hello_reply,
)

HELLO_TIMEOUT_S, HELLO_PERIOD_S = 10.0, 0.5
"""Longest wait for a target [s], and the time between two attempts."""
REPLY_TIMEOUT_S = 2.0
"""Longest wait for the reply of a cycle [s]; an emulator on a busy machine may be slow."""
MAX_SEQUENCE = 2**32 - 1
"""Largest sequence number of a message: 49 days of cycles at 1 kHz without scenes."""
T = TypeVar("T")


class TargetLostError(DualbrainError):
    """The target does not answer; its own watchdog brakes the arm and switches the drive off."""


def derive_session_key(shared: bytes, host_nonce: int, target_nonce: int) -> bytes:
    """The key of a session, from the shared key and both nonces."""
    nonces = host_nonce.to_bytes(8, "little") + target_nonce.to_bytes(8, "little")
    return b"".join(tag(bytes([part]) + nonces, shared) for part in (0, 1))


class TargetSession:
    """An open session; `outputs` are the replies since the last cycle that the target sent when its watchdog acted."""

    def __init__(self, link: Link, key: bytes, robot_hash: int) -> None:
        """Open a session with the target behind `link`, which must have the robot tables with `robot_hash`.

        Raises:
            TargetLostError: no target with this key answers, or its firmware is of another version.
            ConfigurationError: the target has the tables of another robot.
        """
        self.link, self._shared, self._reader = link, key, FrameReader()
        self._sequence = 0
        self.outputs: list[CycleReply] = []
        self.description = self._open(robot_hash)
        if self.description.robot_hash != robot_hash:
            raise ConfigurationError(
                "robot tables of the target",
                got=f"{self.description.robot_hash:016x}",
                allowed=f"{robot_hash:016x}",
                fix="Build and load the firmware for this robot and this filter configuration.",
            )

    def _open(self, robot_hash: int) -> TargetDescription:
        host_nonce = int.from_bytes(os.urandom(8), "little")
        deadline = time.monotonic() + HELLO_TIMEOUT_S
        self._key = self._shared
        while time.monotonic() < deadline:
            sequence = self.send(Message.HELLO, HELLO.pack(host_nonce, robot_hash), key=self._shared)
            reply = self._receive(Message.HELLO_REPLY, sequence, HELLO_PERIOD_S)
            if reply is not None:
                description = _parsed(parse_hello_reply, reply.payload)
                self._key = derive_session_key(self._shared, host_nonce, description.nonce)
                return description
        raise TargetLostError(
            f"No target answered within {HELLO_TIMEOUT_S:g} s. Check the link, and that the firmware has the same key."
        )

    def send(self, kind: Message, payload: bytes, *, key: bytes | None = None) -> int:
        """Send a message; returns its sequence number.

        Raises:
            TargetLostError: the link is closed, the target does not read, or every sequence number was used.
        """
        if self._sequence == MAX_SEQUENCE:
            raise TargetLostError("The session with the target has used every sequence number. Open a new session.")
        self._sequence += 1
        try:
            self.link.write(encode_frame(kind, self._sequence, payload, key or self._key))
        except OSError as error:
            raise TargetLostError(f"The link to the target failed: {error}.") from None
        return self._sequence

    def cycle(self, payload: bytes) -> CycleReply:
        """Send a CYCLE and wait for its reply; clears the outputs of the watchdog before it.

        Raises:
            TargetLostError: there is no reply in time, or one of another form, or the link failed.
        """
        self.outputs.clear()
        sequence = self.send(Message.CYCLE, payload)
        reply = self._receive(Message.CYCLE_REPLY, sequence, REPLY_TIMEOUT_S)
        if reply is None:
            raise TargetLostError(f"The target did not answer within {REPLY_TIMEOUT_S:g} s.")
        return _parsed(parse_cycle_reply, reply.payload)

    def _receive(self, kind: Message, sequence: int, timeout: float) -> Frame | None:
        """The next message of this type and sequence; collects outputs of the watchdog."""
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0.0:
            for piece in self._reader.feed(self._read(left)):
                frame = decode_frame(piece, self._key)
                if frame is None:
                    continue
                if frame.type == Message.OUTPUT:
                    self.outputs.append(_parsed(parse_cycle_reply, frame.payload))
                elif (frame.type, frame.sequence) == (kind, sequence):
                    return frame
        return None

    def _read(self, timeout: float) -> bytes:
        try:
            return self.link.read(timeout)
        except OSError as error:
            raise TargetLostError(f"The link to the target failed: {error}.") from None

    def listen(self, seconds: float) -> list[CycleReply]:
        """Wait without sending; returns the outputs of the watchdog in this time, and clears them.

        Raises:
            TargetLostError: the link failed.
        """
        self._receive(Message.CYCLE_REPLY, -1, seconds)
        outputs, self.outputs = self.outputs, []
        return outputs


def _parsed(parse: Callable[[bytes], T], payload: bytes) -> T:
    """The parsed payload of an authenticated reply; firmware of another version may send one of another form."""
    try:
        return parse(payload)
    except struct.error:
        raise TargetLostError(
            f"The target sent a reply of another form ({len(payload)} bytes). Build and load the firmware of this "
            "version."
        ) from None
