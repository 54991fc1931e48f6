"""Client of the gatekeeper's socket, for a commander, an operator or an observer."""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Condition, Lock, Thread
from threading import Event as Signal
from typing import TypeVar

from dualbrain.control.gatekeeper.protocol.authentication import Keys, contract_mac, hello_proof
from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    CheckReport,
    CheckRequest,
    CountsReport,
    CountsRequest,
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
from dualbrain.control.gatekeeper.timing.tick_counts import TickCounts
from dualbrain.errors import ConfigurationError, DualbrainError

HEARTBEAT_PERIOD = 0.05
"""Time between two heartbeats of a commander [s]."""
REPLY_TIMEOUT = 5.0
"""Longest wait for a short reply [s]."""
SEND_TIMEOUT = 2.0
"""Longest wait [s] for a gatekeeper that does not read; afterwards the connection is lost."""
CONTRACT_LIFETIME = 60.0
"""Time from the issue to the expiry of a contract that the gate has not accepted [s]."""
CLOCK_REPORTS = 20
"""Number of status reports from which the gatekeeper's time is estimated: those of one second."""
CLOCK_ALLOWANCE = 0.02
"""Time [s] that the gatekeeper's clock may lose between two status reports."""
CLOSED_BY_GATEKEEPER = "the gatekeeper closed the connection"
M = TypeVar("M", bound=Message)


class ConnectionLostError(DualbrainError):
    """The gatekeeper closed the connection, refused a request, or did not reply in time."""


class ContractNotCheckedError(ConnectionLostError):
    """The gatekeeper did not check a contract, for the given reason; the connection is not affected."""

    def __init__(self, reason: str) -> None:
        """State the reason that the gatekeeper sent."""
        super().__init__(f"The contract was not checked: {reason}.")


class GatekeeperClient:
    """One connection to a gatekeeper. One thread reads from it; for a commander, another one sends heartbeats."""

    def __init__(
        self,
        path: Path,
        keys: Keys | None = None,
        principal: str = "",
        *,
        on_report: Callable[[Message], None] | None = None,
    ) -> None:
        """Connect and authenticate; without a principal, the client may only observe and press the emergency stop.

        `on_report` gets event and tick reports on the reading thread. Raises `ConfigurationError` if no gatekeeper
        listens at `path`, and `ConnectionLostError` if it refuses the connection.
        """
        self._on_report = on_report
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _as_timeval(SEND_TIMEOUT))
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ConfigurationError.stating(
                f"No gatekeeper listens at {path}: {error.strerror}.",
                fix="Start `dualbrain gatekeeper`, or name a running one with --socket and --keys (`dualbrain doctor` "
                "lists them).",
            ) from error
        self._secret = keys.secrets[principal] if keys and principal else b""
        self._lock, self._sent = Lock(), 0
        self._replies: Queue[Message] = Queue()
        self._proposing, self._verdict_missing = Lock(), False
        self._scene_order, self._scenes_requested = Lock(), 0
        self._scene_arrived, self._scenes_received = Condition(), 0
        self._newest_scene: SceneReport | None = None
        self._check_reports: Queue[CheckReport] = Queue()
        self._check_lock = Lock()
        self.status: StatusReport | None = None
        self.disconnected = Signal()
        self.disconnect_reason = ""
        self._clock_offsets: deque[float] = deque(maxlen=CLOCK_REPORTS)
        self.nonce, self._received_at = b"", time.monotonic()
        Thread(target=self._read_messages, name="gatekeeper client", daemon=True).start()
        try:
            self.welcome = self._authenticate(principal)
        except ConnectionLostError:
            self.close()
            raise
        self._follow_clock(self.welcome.now)
        if self.welcome.role == "commander":
            Thread(target=self._send_heartbeats, name="heartbeat", daemon=True).start()

    def _authenticate(self, principal: str) -> Welcome:
        """Reply to the challenge of the gatekeeper."""
        self.nonce = self.expect(Challenge).nonce
        proof = hello_proof(self._secret, self.nonce, principal) if principal else b""
        self.send(Hello(principal=principal, proof=proof, watch=self._on_report is not None))
        return self.expect(Welcome)

    @property
    def now(self) -> float:
        """Lower bound of the gatekeeper's time [s].

        The clock of a robot is not that of this host: it drifts, and a simulator that the host stops loses time. The
        slowest of the last reports counts, because a contract with a later stamp comes from the future.
        """
        return time.monotonic() + min(tuple(self._clock_offsets)) - CLOCK_ALLOWANCE

    @property
    def silence(self) -> float:
        """Time [s] since the gatekeeper sent anything; while it works, it sends its status every 50 ms."""
        return time.monotonic() - self._received_at

    def _follow_clock(self, now: float) -> None:
        """Note the gatekeeper's time `now` [s] in a message that has just arrived."""
        self._clock_offsets.append(now - time.monotonic())

    def send(self, message: Message) -> int:
        """Send a message; returns its sequence number. Raises `ConnectionLostError`."""
        with self._lock:
            self._sent += 1
            self._send_bytes(encode(kind_code(message), self._sent, encode_body(message)))
            return self._sent

    def propose(
        self, contract: bytes, scene_version: int, *, lifetime: float = CONTRACT_LIFETIME
    ) -> VerdictReport | RequestRefused:
        """Submit an authenticated contract; returns the gate's verdict, or the reason why it was not checked.

        The contract expires `lifetime` [s] after its issue. Late replies to earlier contracts are dropped. Raises
        `ConnectionLostError`, also if no verdict arrives in time; the contract may then still begin.
        """
        with self._proposing:
            self._drop_late_replies()
            self._verdict_missing = True
            reply = self._wait_for_verdict(self.submit(contract, scene_version, lifetime=lifetime))
            self._verdict_missing = False
            return reply

    def _drop_late_replies(self) -> None:
        """Drop all verdicts and outcomes, which belong to earlier contracts.

        A refusal names no contract. If the reply to the last contract is missing, a scene is requested first: the
        gatekeeper sends its replies in order, so no refusal of that contract follows the scene.
        """
        if self._verdict_missing:
            self.request_scene(REPLY_TIMEOUT)
        with suppress(Empty):
            while True:
                self._replies.get_nowait()

    def _wait_for_verdict(self, sequence: int) -> VerdictReport | RequestRefused:
        """The reply to the contract in frame `sequence`; replies to earlier ones are dropped."""
        deadline = time.monotonic() + REPLY_TIMEOUT
        while (left := deadline - time.monotonic()) > 0.0 and not (
            self.disconnected.is_set() and self._replies.empty()
        ):
            with suppress(Empty):
                reply = self._replies.get(timeout=min(left, 0.05))
                if isinstance(reply, RequestRefused) or (
                    isinstance(reply, VerdictReport) and reply.sequence == sequence
                ):
                    return reply
        if self.disconnected.is_set():
            raise ConnectionLostError(self.disconnect_reason or CLOSED_BY_GATEKEEPER)
        raise ConnectionLostError(
            f"no verdict on the contract arrived within {REPLY_TIMEOUT} s, and it may still begin; stop the robot, or "
            "look at the scene before the next contract"
        )

    def submit(self, contract: bytes, scene_version: int, *, lifetime: float = CONTRACT_LIFETIME) -> int:
        """As `propose`, without waiting for the reply; returns the sequence number of the frame."""
        with self._lock:
            self._sent += 1
            issued, expires = self.now, self.now + lifetime
            mac = contract_mac(
                self._secret,
                self.nonce,
                self._sent,
                contract,
                issued=issued,
                expires=expires,
                scene_version=scene_version,
            )
            message = Propose(contract=contract, issued=issued, expires=expires, scene_version=scene_version, mac=mac)
            self._send_bytes(encode(kind_code(message), self._sent, encode_body(message)))
            return self._sent

    def check(self, contract: bytes) -> CheckReport:
        """The gate's verdict on `contract` in the present state, without any effect; also while a contract runs.

        Raises `ConnectionLostError`; if the gatekeeper does not check the contract, because it checks another one or
        this client is not the commander, `ContractNotCheckedError`.
        """
        with self._check_lock:
            sequence, deadline = self.send(CheckRequest(contract=contract)), time.monotonic() + REPLY_TIMEOUT
            while time.monotonic() < deadline and not self.disconnected.is_set():
                with suppress(Empty):
                    report = self._check_reports.get(timeout=0.05)
                    if report.sequence == sequence:
                        return _checked(report)
        raise ConnectionLostError(self.disconnect_reason or f"no CheckReport within {REPLY_TIMEOUT} s")

    def operate(self, act: OperatorAction, speed: float = 1.0) -> None:
        """Send an operator command; `speed` (0, 1] belongs to the action "speed". Raises `ConnectionLostError`."""
        self.send(OperatorCommand(act=act, speed=speed))

    def request_scene(self, timeout: float = REPLY_TIMEOUT) -> SceneReport:
        """The current scene and joint state, within `timeout` [s]; other messages remain in their queue.

        The gatekeeper answers every request, in order, so that a late answer to an earlier request is recognised.
        Raises `ConnectionLostError`.
        """
        with self._scene_order:
            self._scenes_requested += 1
            number = self._scenes_requested
            self.send(SceneRequest())
        return self._wait_for_scene(number, timeout)

    def request_counts(self, timeout: float = REPLY_TIMEOUT) -> TickCounts:
        """The counts of all ticks so far, within `timeout` [s]. Raises `ConnectionLostError`.

        A gatekeeper of an older version closes the connection: "kind 17 is not known".
        """
        self.send(CountsRequest())
        return self.expect(CountsReport, timeout).counts

    def _wait_for_scene(self, number: int, timeout: float) -> SceneReport:
        """The newest report, once that on request `number` has arrived."""
        deadline = time.monotonic() + timeout
        with self._scene_arrived:
            while self._scenes_received < number and time.monotonic() < deadline and not self.disconnected.is_set():
                self._scene_arrived.wait(0.05)
            if self._newest_scene is not None and self._scenes_received >= number:
                return self._newest_scene
        raise ConnectionLostError(self.disconnect_reason or f"no SceneReport within {timeout} s")

    def wait_for_outcome(self, timeout: float | None = None) -> OutcomeReport:
        """Wait until the running contract ends, at most `timeout` [s]; raises `ConnectionLostError`."""
        return self.expect(OutcomeReport, timeout)

    def poll_outcome(self, timeout: float) -> OutcomeReport | None:
        """As `wait_for_outcome`, but None if the contract has not ended within `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if self.disconnected.is_set() and self._replies.empty():
                raise ConnectionLostError(self.disconnect_reason or CLOSED_BY_GATEKEEPER)
            try:
                message = self._replies.get(timeout=0.02)
            except Empty:
                continue
            if isinstance(message, OutcomeReport):
                return message
        return None

    def expect(self, kind: type[M], timeout: float | None = REPLY_TIMEOUT) -> M:
        """The next message of `kind`; others are dropped. Raises `ConnectionLostError`, also for a refused request."""
        message = self._receive_any(kind, RequestRefused, timeout=timeout)
        if isinstance(message, RequestRefused):
            raise ConnectionLostError(message.reason)
        return message

    def lose(self, reason: str) -> ConnectionLostError:
        """End the connection because of `reason`, and return the error to raise; the gatekeeper stops the contract."""
        self.disconnect_reason = reason
        self.disconnected.set()
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # no frame may follow a cut one
        return ConnectionLostError(reason)

    def close(self) -> None:
        """Close the connection."""
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
                    raise ConnectionLostError(self.disconnect_reason or CLOSED_BY_GATEKEEPER) from None
                continue
            if isinstance(message, kinds):
                return message
        raise ConnectionLostError(f"no {kinds[0].__name__} within {timeout} s")

    def _send_bytes(self, data: bytes) -> None:
        """Send a frame; if the gatekeeper does not take it in time, the frame may be cut, and the connection ends."""
        try:
            self._socket.sendall(data)
        except BlockingIOError as error:
            raise self.lose(f"the gatekeeper has read nothing for {SEND_TIMEOUT:g} s") from error
        except OSError as error:
            self.disconnected.set()
            raise ConnectionLostError(error.strerror or CLOSED_BY_GATEKEEPER) from error

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
            self._received_at = time.monotonic()
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
                self._follow_clock(message.now)
            case EventReport() | TickReport():
                if self._on_report:
                    self._on_report(message)
            case SceneReport():
                with self._scene_arrived:
                    self._scenes_received, self._newest_scene = self._scenes_received + 1, message
                    self._scene_arrived.notify_all()
            case CheckReport():
                self._check_reports.put(message)
            case _:
                self._replies.put(message)


def _as_timeval(seconds: float) -> bytes:
    """The `struct timeval` of a time [s], for a socket option."""
    return struct.pack("@ll", int(seconds), int(seconds % 1.0 * 1e6))


def _checked(report: CheckReport) -> CheckReport:
    """`report`, if the contract was checked; raises `ContractNotCheckedError` otherwise."""
    if report.refused:
        raise ContractNotCheckedError(report.refused)
    return report
