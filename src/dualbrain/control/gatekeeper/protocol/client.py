"""The other end of the socket: for the cortex (commander), for a person (operator), for whoever only watches."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Event as Signal
from threading import Lock, Thread
from typing import TypeVar

from dualbrain.control.gatekeeper.protocol.authentication import Keys, contract_mac, hello_proof
from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    EventReport,
    Heartbeat,
    Hello,
    Message,
    OperatorAction,
    OperatorCommand,
    OutcomeReport,
    Propose,
    RequestRefused,
    SceneReport,
    SceneRequest,
    StatusReport,
    TickReport,
    VerdictReport,
    Welcome,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.errors import ConfigurationError, DualbrainError

HEARTBEAT_PERIOD = 0.05
"""A commander's heartbeat [s]."""
REPLY_TIMEOUT = 5.0
"""How long to wait for a short answer [s]."""
CONTRACT_LIFETIME = 60.0
"""A contract is meant to be judged within this time [s]."""
M = TypeVar("M", bound=Message)


class ConnectionLostError(DualbrainError):
    """The gatekeeper hung up, or fell silent."""


class GatekeeperClient:
    """One connection. Reads on a thread of its own; a commander's heart beats on another."""

    def __init__(
        self,
        path: Path,
        keys: Keys | None = None,
        principal: str = "",
        *,
        on_report: Callable[[Message], None] | None = None,
    ) -> None:
        """Connect and say who we are; without a principal one may only look, and press the emergency stop.

        Raises `InvalidSetup` when nobody listens, `LinkLost` when we are not let in. `watch` is given news and
        glimpses, on the reading thread.
        """
        self._on_report = on_report
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ConfigurationError(
                "gatekeeper",
                got=error.strerror,
                allowed="one that listens",
                fix=f"Start `dualbrain gatekeeper`. {path}",
            ) from error
        self._secret = keys.secrets[principal] if keys and principal else b""
        self._lock, self._sent = Lock(), 0
        self._replies: Queue[Message] = Queue()
        self._scene_reports: Queue[SceneReport] = Queue()
        self.status: StatusReport | None = None
        self.disconnected = Signal()
        self.disconnect_reason = ""
        self._clock_offset = 0.0
        self.nonce = b""
        Thread(target=self._read_messages, name="gatekeeper link", daemon=True).start()
        try:
            self.welcome = self._authenticate(principal)
        except ConnectionLostError:
            self.close()
            raise
        self._clock_offset = self.welcome.now - time.monotonic()
        if self.welcome.role == "commander":
            Thread(target=self._send_heartbeats, name="heartbeat", daemon=True).start()

    def _authenticate(self, principal: str) -> Welcome:
        """Answer the challenge."""
        self.nonce = self.expect(Challenge).nonce
        proof = hello_proof(self._secret, self.nonce, principal) if principal else b""
        self.send(Hello(principal=principal, proof=proof, watch=self._on_report is not None))
        return self.expect(Welcome)

    @property
    def now(self) -> float:
        """The gatekeeper's time as far as it is known here [s]."""
        return time.monotonic() + self._clock_offset

    def send(self, message: Message) -> int:
        """Send a message; its sequence number."""
        with self._lock:
            self._sent += 1
            self._send_bytes(encode(kind_code(message), self._sent, encode_body(message)))
            return self._sent

    def propose(
        self, contract: bytes, scene_version: int, *, lifetime: float = CONTRACT_LIFETIME
    ) -> VerdictReport | RequestRefused:
        """Hand in a contract, sealed; the gate's answer, or why it was not even looked at."""
        self.submit(contract, scene_version, lifetime=lifetime)
        return self._receive_any(VerdictReport, RequestRefused)

    def submit(self, contract: bytes, scene_version: int, *, lifetime: float = CONTRACT_LIFETIME) -> int:
        """As `propose`, without waiting for the answer; the number of the frame."""
        with self._lock:
            self._sent += 1
            issued, expires = self.now, self.now + lifetime
            tag = contract_mac(
                self._secret,
                self.nonce,
                self._sent,
                contract,
                issued=issued,
                expires=expires,
                scene_version=scene_version,
            )
            message = Propose(contract=contract, issued=issued, expires=expires, scene_version=scene_version, mac=tag)
            self._send_bytes(encode(kind_code(message), self._sent, encode_body(message)))
            return self._sent

    def operate(self, act: OperatorAction, speed: float = 1.0) -> None:
        """A person's hand."""
        self.send(OperatorCommand(act=act, speed=speed))

    def request_scene(self) -> SceneReport:
        """What a planner needs to know, now; what came before it stays to be taken out."""
        self.send(SceneRequest())
        return self._wait_for_scene(REPLY_TIMEOUT)

    def _wait_for_scene(self, timeout: float) -> SceneReport:
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            with suppress(Empty):
                return self._scene_reports.get(timeout=0.05)
            if self.disconnected.is_set():
                break
        raise ConnectionLostError(self.disconnect_reason or "nothing to be seen")

    def wait_for_outcome(self, timeout: float | None = None) -> OutcomeReport:
        """Wait until the contract that runs is over; raises `LinkLost` when the gatekeeper is gone."""
        return self.expect(OutcomeReport, timeout)

    def poll_outcome(self, timeout: float) -> OutcomeReport | None:
        """As `ended`, but None when there is no end within `patience` [s]."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if self.disconnected.is_set() and self._replies.empty():
                raise ConnectionLostError(self.disconnect_reason or "the gatekeeper hung up")
            try:
                message = self._replies.get(timeout=0.02)
            except Empty:
                continue
            if isinstance(message, OutcomeReport):
                return message
        return None

    def expect(self, kind: type[M], timeout: float | None = REPLY_TIMEOUT) -> M:
        """The next message of `kind`; others are dropped, a refusal is raised."""
        message = self._receive_any(kind, RequestRefused, timeout=timeout)
        if isinstance(message, RequestRefused):
            raise ConnectionLostError(message.reason)
        return message

    def close(self) -> None:
        """Hang up."""
        self.disconnected.set()
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _receive_any(self, *kinds: type[M], timeout: float | None = REPLY_TIMEOUT) -> M:
        deadline = None if timeout is None else time.monotonic() + timeout
        while deadline is None or time.monotonic() < deadline:
            try:
                message = self._replies.get(timeout=0.05)
            except Empty:
                if self.disconnected.is_set():
                    raise ConnectionLostError(self.disconnect_reason or "the gatekeeper hung up") from None
                continue
            if isinstance(message, kinds):
                return message
        raise ConnectionLostError(f"no {kinds[0].__name__} within {timeout} s")

    def _send_bytes(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            self.disconnected.set()
            raise ConnectionLostError(error.strerror or "the gatekeeper hung up") from error

    def _send_heartbeats(self) -> None:
        while not self.disconnected.wait(HEARTBEAT_PERIOD):
            try:
                self.send(Heartbeat())
            except ConnectionLostError:
                return

    def _read_messages(self) -> None:
        decoder = FrameDecoder()
        while not self.disconnected.is_set():
            try:
                data = self._socket.recv(65536)
            except OSError:
                break
            if not data:
                break
            decoder.feed(data)
            while (frame := decoder.next_frame()) is not None:
                if isinstance(frame, BrokenStream):
                    self.disconnect_reason = frame.reason
                    self.disconnected.set()
                    return
                self._dispatch(decode_message(frame, from_client=False))
        self.disconnected.set()

    def _dispatch(self, message: Message | str) -> None:
        match message:
            case str():
                self.disconnect_reason = message
            case StatusReport():
                self.status = message
            case EventReport() | TickReport():
                if self._on_report:
                    self._on_report(message)
            case SceneReport():
                self._scene_reports.put(message)
            case _:
                self._replies.put(message)
