"""A commander in lockstep with its gatekeeper, whose planner or socket fails; all other code is that of a run.

The commander uses the gatekeeper's protocol over a real socket: it authenticates itself, requests the scene, proposes
one contract and sends heartbeats. A faulty *planner* proposes wrong contracts with valid authentication codes; a faulty
*socket* corrupts the bytes.
"""

from __future__ import annotations

import socket
from collections import deque
from contextlib import suppress
from pathlib import Path

from dualbrain.control.gatekeeper.protocol.authentication import Keys, contract_mac, hello_proof
from dualbrain.control.gatekeeper.protocol.client import CONTRACT_LIFETIME, HEARTBEAT_PERIOD
from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    Heartbeat,
    Hello,
    Message,
    Propose,
    SceneReport,
    SceneRequest,
    Welcome,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.evaluation.fault_injection.faults import DELAY_TIME, SLOW_UPDATE_TICKS, FaultInjector

FAULTY_PROPOSAL_PERIOD = 0.2
"""Time between two proposals of a faulty planner [s]."""
MAX_GARBAGE_BYTES = 400
"""Longest proposal of random bytes."""


class FaultyCommander:
    """A commander that proposes `contract` once; a planner with the fault "wrong" proposes `forbidden_contract`."""

    def __init__(
        self,
        path: Path,
        keys: Keys,
        principal: str,
        injector: FaultInjector,
        contract: bytes,
        forbidden_contract: bytes,
    ) -> None:
        """Connect to the server at `path`; the messages follow in `step`, once per tick."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.connect(str(path))
        self._socket.setblocking(False)
        self._secret, self._principal, self._injector = keys.secrets[principal], principal, injector
        self._contract, self._forbidden_contract = contract, forbidden_contract
        self._decoder = FrameDecoder()
        self._nonce, self._sent, self._scene_version = b"", 0, 0
        self._heartbeat_at = self._faulty_proposal_at = 0.0
        self._queue: deque[tuple[float, bytes]] = deque()
        self._last_frame = b""
        self._proposing_stopped = False

    def step(self, now: float) -> None:
        """Process received messages, and send the messages that are due at `now` [s]."""
        for message in self._receive():
            self._respond(message, now)
        if self._scene_version and now - self._heartbeat_at >= HEARTBEAT_PERIOD:
            self._heartbeat_at = now
            self._send(Heartbeat(), now)
        if (
            not self._proposing_stopped
            and self._injector.is_active("planner")
            and now - self._faulty_proposal_at >= FAULTY_PROPOSAL_PERIOD
        ):
            self._faulty_proposal_at = now
            self._send_faulty_proposal(now)
        self._flush(now)

    def stop_proposing(self) -> None:
        """Propose nothing more, because the episode has ended; heartbeats continue."""
        self._proposing_stopped = True

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _receive(self) -> list[Message]:
        with suppress(OSError):
            self._decoder.feed(self._socket.recv(1 << 16))
        messages: list[Message] = []
        while (frame := self._decoder.next_frame()) is not None and not isinstance(frame, BrokenStream):
            message = decode_message(frame, from_client=False)
            if not isinstance(message, str):
                messages.append(message)
        return messages

    def _respond(self, message: Message, now: float) -> None:
        match message:
            case Challenge(nonce):
                self._nonce = nonce
                proof = hello_proof(self._secret, nonce, self._principal)
                self._send(Hello(principal=self._principal, proof=proof), now)
            case Welcome():
                self._send(SceneRequest(), now)
            case SceneReport() if not self._scene_version:
                self._scene_version = message.scene.version
                self._propose(self._contract, now)
            case _:
                pass

    def _send_faulty_proposal(self, now: float) -> None:
        """Propose as a faulty planner does while a contract runs: again, garbage, forbidden, or expired contracts."""
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "stuck":
                self._propose(self._contract, now)
            case "garbage" | "intermittent":
                self._propose(rng.bytes(int(rng.integers(1, MAX_GARBAGE_BYTES))), now)
            case "wrong":
                self._propose(self._forbidden_contract, now)
            case "delayed":
                self._propose(self._contract, now - 2.0 * CONTRACT_LIFETIME)
            case _:  # off, slow: no proposal, only heartbeats
                pass

    def _propose(self, contract: bytes, issued: float) -> None:
        """Propose `contract` with a valid authentication code; `issued` is in [s]."""
        sequence, expires = self._sent + 1, issued + CONTRACT_LIFETIME
        mac = contract_mac(
            self._secret,
            self._nonce,
            sequence,
            contract,
            issued=issued,
            expires=expires,
            scene_version=self._scene_version,
        )
        message = Propose(contract=contract, issued=issued, expires=expires, scene_version=self._scene_version, mac=mac)
        self._send(message, self._injector.now())

    # --- socket -------------------------------------------------------------------------------------------------

    def _send(self, message: Message, now: float) -> None:
        self._sent += 1
        data = encode(kind_code(message), self._sent, encode_body(message))
        before, self._last_frame = self._last_frame, data
        if self._injector.is_active("socket"):
            self._corrupt(data, before, now)
        else:
            self._queue.append((now, data))

    def _corrupt(self, data: bytes, before: bytes, now: float) -> None:
        match self._injector.fault.kind:
            case "off":
                self._socket.close()
            case "garbage":
                self._queue.append((now, self._injector.rng.bytes(len(data))))
            case "wrong":  # the previous frame again
                self._queue.append((now, before))
            case "slow":  # all frames of a period at once
                period = SLOW_UPDATE_TICKS * HEARTBEAT_PERIOD
                self._queue.append(((now // period + 1.0) * period, data))
            case "delayed":
                self._queue.append((now + DELAY_TIME, data))
            case _:  # stuck, intermittent: the frame is lost
                pass

    def _flush(self, now: float) -> None:
        while self._queue and self._queue[0][0] <= now:
            with suppress(OSError):
                self._socket.sendall(self._queue[0][1])
            self._queue.popleft()
