"""A commander in lockstep with its gatekeeper, whose planner or whose socket breaks; everything else is the real thing.

It speaks the gatekeeper's own frames over a real socket: it proves who it is, looks, proposes one errand under seal,
and beats its heart. A broken *planner* says wrong things under good seals; a broken *socket* spoils the bytes.
"""

from __future__ import annotations

import socket
from collections import deque
from contextlib import suppress
from pathlib import Path

from dualbrain.control.gatekeeper.protocol.authentication import Keys, prove, seal
from dualbrain.control.gatekeeper.protocol.client import BEAT_EVERY, LIFE
from dualbrain.control.gatekeeper.protocol.frames import Broken, Decoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    Heartbeat,
    Hello,
    Look,
    Message,
    Propose,
    Sight,
    Welcome,
    encode_body,
    kind_of,
    read,
)
from dualbrain.evaluation.fault_injection.faults import LATE, SLOW_EVERY, Injector

ASK_EVERY = 0.2
"""How often a planner that is broken talks [s]."""
LONGEST_RUBBISH = 400


class FaultyCommander:
    """`step(now)` once a tick; `errand` is proposed once, `folly` is what a planner that is wrong asks for."""

    def __init__(
        self, path: Path, keys: Keys, principal: str, injector: Injector, errand: bytes, folly: bytes
    ) -> None:  # fmt: skip
        """Connect; nothing is said yet."""
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._link.connect(str(path))
        self._link.setblocking(False)
        self._secret, self._principal, self._injector = keys.secrets[principal], principal, injector
        self._errand, self._folly = errand, folly
        self._decoder = Decoder()
        self._nonce, self._sent, self._version = b"", 0, 0
        self._beat_at = self._asked_at = 0.0
        self._queue: deque[tuple[float, bytes]] = deque()
        self._last = b""
        self._hushed = False

    def step(self, now: float) -> None:
        """Hear what came, say what is due at `now` [s]."""
        for message in self._heard():
            self._answer(message, now)
        if self._version and now - self._beat_at >= BEAT_EVERY:
            self._beat_at = now
            self._say(Heartbeat(), now)
        if not self._hushed and self._injector.strikes("planner") and now - self._asked_at >= ASK_EVERY:
            self._asked_at = now
            self._babble(now)
        self._release(now)

    def hush(self) -> None:
        """From now on nothing more is proposed: the episode is over, and its heart beats on."""
        self._hushed = True

    def close(self) -> None:
        """Hang up."""
        self._link.close()

    def _heard(self) -> list[Message]:
        with suppress(OSError):
            self._decoder.feed(self._link.recv(1 << 16))
        found: list[Message] = []
        while (frame := self._decoder.next()) is not None and not isinstance(frame, Broken):
            message = read(frame, upward=False)
            if not isinstance(message, str):
                found.append(message)
        return found

    def _answer(self, message: Message, now: float) -> None:
        match message:
            case Challenge(nonce):
                self._nonce = nonce
                proof = prove(self._secret, nonce, self._principal)
                self._say(Hello(principal=self._principal, proof=proof), now)
            case Welcome():
                self._say(Look(), now)
            case Sight() if not self._version:
                self._version = message.scene.version
                self._propose(self._errand, now)
            case _:
                pass

    def _babble(self, now: float) -> None:
        """What a broken planner says while its last contract runs: too much, rubbish, folly, or what is long over."""
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "stuck":
                self._propose(self._errand, now)
            case "garbage" | "intermittent":
                self._propose(rng.bytes(int(rng.integers(1, LONGEST_RUBBISH))), now)
            case "wrong":
                self._propose(self._folly, now)
            case "delayed":
                self._propose(self._errand, now - 2.0 * LIFE)
            case _:  # off, slow: it says nothing, and its heart beats on
                pass

    def _propose(self, contract: bytes, issued: float) -> None:
        """Sealed as it should be, whatever is in it."""
        number, expires = self._sent + 1, issued + LIFE
        tag = seal(
            self._secret, self._nonce, number, contract, issued=issued, expires=expires, version=self._version
        )  # fmt: skip
        message = Propose(contract=contract, issued=issued, expires=expires, scene_version=self._version, seal=tag)
        self._say(message, self._injector.now())

    # --- the wire -----------------------------------------------------------------------------------------------

    def _say(self, message: Message, now: float) -> None:
        self._sent += 1
        data = encode(kind_of(message), self._sent, encode_body(message))
        before, self._last = self._last, data
        if self._injector.strikes("socket"):
            self._spoil(data, before, now)
        else:
            self._queue.append((now, data))

    def _spoil(self, data: bytes, before: bytes, now: float) -> None:
        match self._injector.fault.kind:
            case "off":
                self._link.close()
            case "garbage":
                self._queue.append((now, self._injector.rng.bytes(len(data))))
            case "wrong":  # what was said before, again
                self._queue.append((now, before))
            case "slow":  # everything comes, in one go, once in a while
                period = SLOW_EVERY * BEAT_EVERY
                self._queue.append(((now // period + 1.0) * period, data))
            case "delayed":
                self._queue.append((now + LATE, data))
            case _:  # stuck, intermittent: it never leaves
                pass

    def _release(self, now: float) -> None:
        while self._queue and self._queue[0][0] <= now:
            with suppress(OSError):
                self._link.sendall(self._queue[0][1])
            self._queue.popleft()
