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

from dualbrain.control.gatekeeper.protocol.authentication import Keys, prove, seal
from dualbrain.control.gatekeeper.protocol.frames import Broken, Decoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Act,
    Answer,
    Beat,
    Challenge,
    Ended,
    Glimpse,
    Heartbeat,
    Hello,
    Look,
    Message,
    News,
    Operate,
    Propose,
    Refused,
    Sight,
    Welcome,
    encode_body,
    kind_of,
    read,
)
from dualbrain.errors import DualbrainError, InvalidSetup

BEAT_EVERY = 0.05
"""A commander's heartbeat [s]."""
PATIENCE = 5.0
"""How long to wait for a short answer [s]."""
LIFE = 60.0
"""A contract is meant to be judged within this time [s]."""
M = TypeVar("M", bound=Message)


class LinkLost(DualbrainError):
    """The gatekeeper hung up, or fell silent."""


class GatekeeperLink:
    """One connection. Reads on a thread of its own; a commander's heart beats on another."""

    def __init__(
        self,
        path: Path,
        keys: Keys | None = None,
        principal: str = "",
        *,
        watch: Callable[[Message], None] | None = None,
    ) -> None:
        """Connect and say who we are; without a principal one may only look, and press the emergency stop.

        Raises `InvalidSetup` when nobody listens, `LinkLost` when we are not let in. `watch` is given news and
        glimpses, on the reading thread.
        """
        self._watch = watch
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._link.connect(str(path))
        except OSError as error:
            self._link.close()
            raise InvalidSetup(
                "gatekeeper",
                got=error.strerror,
                allowed="one that listens",
                fix=f"Start `dualbrain gatekeeper`. {path}",
            ) from error
        self._secret = keys.secrets[principal] if keys and principal else b""
        self._lock, self._sent = Lock(), 0
        self._said: Queue[Message] = Queue()
        self._sights: Queue[Sight] = Queue()
        self.beat: Beat | None = None
        self.lost = Signal()
        self.why = ""
        self._skew = 0.0
        self.nonce = b""
        Thread(target=self._listen, name="gatekeeper link", daemon=True).start()
        try:
            self.welcome = self._introduce(principal)
        except LinkLost:
            self.close()
            raise
        self._skew = self.welcome.now - time.monotonic()
        if self.welcome.role == "commander":
            Thread(target=self._beat, name="heartbeat", daemon=True).start()

    def _introduce(self, principal: str) -> Welcome:
        """Answer the challenge."""
        self.nonce = self.expect(Challenge).nonce
        proof = prove(self._secret, self.nonce, principal) if principal else b""
        self.say(Hello(principal=principal, proof=proof, watch=self._watch is not None))
        return self.expect(Welcome)

    @property
    def now(self) -> float:
        """The gatekeeper's time as far as it is known here [s]."""
        return time.monotonic() + self._skew

    def say(self, message: Message) -> int:
        """Send a message; its sequence number."""
        with self._lock:
            self._sent += 1
            self._send(encode(kind_of(message), self._sent, encode_body(message)))
            return self._sent

    def propose(self, contract: bytes, scene_version: int, *, life: float = LIFE) -> Answer | Refused:
        """Hand in a contract, sealed; the gate's answer, or why it was not even looked at."""
        self.hand_in(contract, scene_version, life=life)
        return self._any(Answer, Refused)

    def hand_in(self, contract: bytes, scene_version: int, *, life: float = LIFE) -> int:
        """As `propose`, without waiting for the answer; the number of the frame."""
        with self._lock:
            self._sent += 1
            issued, expires = self.now, self.now + life
            tag = seal(
                self._secret, self.nonce, self._sent, contract, issued=issued, expires=expires, version=scene_version
            )  # fmt: skip
            message = Propose(
                contract=contract, issued=issued, expires=expires, scene_version=scene_version, seal=tag
            )  # fmt: skip
            self._send(encode(kind_of(message), self._sent, encode_body(message)))
            return self._sent

    def operate(self, act: Act, speed: float = 1.0) -> None:
        """A person's hand."""
        self.say(Operate(act=act, speed=speed))

    def look(self) -> Sight:
        """What a planner needs to know, now; what came before it stays to be taken out."""
        self.say(Look())
        return self._seen(PATIENCE)

    def _seen(self, timeout: float) -> Sight:
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            with suppress(Empty):
                return self._sights.get(timeout=0.05)
            if self.lost.is_set():
                break
        raise LinkLost(self.why or "nothing to be seen")

    def ended(self, timeout: float | None = None) -> Ended:
        """Wait until the contract that runs is over; raises `LinkLost` when the gatekeeper is gone."""
        return self.expect(Ended, timeout)

    def ended_by_now(self, patience: float) -> Ended | None:
        """As `ended`, but None when there is no end within `patience` [s]."""
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            if self.lost.is_set() and self._said.empty():
                raise LinkLost(self.why or "the gatekeeper hung up")
            try:
                message = self._said.get(timeout=0.02)
            except Empty:
                continue
            if isinstance(message, Ended):
                return message
        return None

    def expect(self, kind: type[M], timeout: float | None = PATIENCE) -> M:
        """The next message of `kind`; others are dropped, a refusal is raised."""
        message = self._any(kind, Refused, timeout=timeout)
        if isinstance(message, Refused):
            raise LinkLost(message.reason)
        return message

    def close(self) -> None:
        """Hang up."""
        self.lost.set()
        with suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)
        self._link.close()

    def _any(self, *kinds: type[M], timeout: float | None = PATIENCE) -> M:
        deadline = None if timeout is None else time.monotonic() + timeout
        while deadline is None or time.monotonic() < deadline:
            try:
                message = self._said.get(timeout=0.05)
            except Empty:
                if self.lost.is_set():
                    raise LinkLost(self.why or "the gatekeeper hung up") from None
                continue
            if isinstance(message, kinds):
                return message
        raise LinkLost(f"no {kinds[0].__name__} within {timeout} s")

    def _send(self, data: bytes) -> None:
        try:
            self._link.sendall(data)
        except OSError as error:
            self.lost.set()
            raise LinkLost(error.strerror or "the gatekeeper hung up") from error

    def _beat(self) -> None:
        while not self.lost.wait(BEAT_EVERY):
            try:
                self.say(Heartbeat())
            except LinkLost:
                return

    def _listen(self) -> None:
        decoder = Decoder()
        while not self.lost.is_set():
            try:
                data = self._link.recv(65536)
            except OSError:
                break
            if not data:
                break
            decoder.feed(data)
            while (frame := decoder.next()) is not None:
                if isinstance(frame, Broken):
                    self.why = frame.reason
                    self.lost.set()
                    return
                self._sort(read(frame, upward=False))
        self.lost.set()

    def _sort(self, message: Message | str) -> None:
        match message:
            case str():
                self.why = message
            case Beat():
                self.beat = message
            case News() | Glimpse():
                if self._watch:
                    self._watch(message)
            case Sight():
                self._sights.put(message)
            case _:
                self._said.put(message)
