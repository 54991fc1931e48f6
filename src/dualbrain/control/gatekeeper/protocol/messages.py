"""What is said over the socket. Strictly typed MessagePack; an unknown field, type or kind is refused, never guessed.

Upward (to the gatekeeper): `Hello`, `Heartbeat`, `Propose`, `Operate`, `Look`. Downward: `Challenge`, `Welcome`,
`Beat`, `Answer`, `Ended`, `Sight`, `News`, `Glimpse`, `Refused`. A contract travels as raw bytes; only the gatekeeper's
own gate reads it.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.protocol.frames import Frame
from dualbrain.errors import DECODE_ERRORS
from dualbrain.records import Outcome, Scene

OperatorAction = Literal[
    "pause", "resume", "abort", "takeover", "hand_back", "speed", "estop", "release_estop", "reset", "shut_down"
]
"""What a person may do. Everyone may press `estop`; only the operator's key releases, resets, resumes or speeds up."""


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Root of the messages."""


class Hello(Message, frozen=True, kw_only=True):
    """Who is there: `proof` = HMAC over the challenge. Without a key one may only look (principal "", proof empty)."""

    principal: str
    proof: bytes
    watch: bool = False


class Heartbeat(Message, frozen=True):
    """The commander is alive."""


class Propose(Message, frozen=True, kw_only=True, rename={"mac": "seal"}):
    """A contract, unread, with what the commander's side stamps around it; `seal` covers all of it.

    `issued` and `expires` [s] are in the gatekeeper's time; the frame's own sequence number is the stamp's.
    """

    contract: bytes
    issued: float
    expires: float
    scene_version: int
    mac: bytes


class OperatorCommand(Message, frozen=True, kw_only=True):
    """A person's hand; `speed` (0, 1] belongs to act "speed"."""

    act: OperatorAction
    speed: float = 1.0


class SceneRequest(Message, frozen=True):
    """Ask for a `Sight`."""


class Challenge(Message, frozen=True):
    """First word on every connection: a fresh nonce, which also names the session."""

    nonce: bytes


class Welcome(Message, frozen=True, kw_only=True):
    """You are `role` now; `now` [s] is the gatekeeper's time."""

    role: Literal["commander", "operator", "observer"]
    now: float
    robot: str
    registry: str


class StatusReport(Message, frozen=True, kw_only=True):
    """The gatekeeper is alive: its time [s], the order in force, whether a contract runs."""

    now: float
    action: str
    cause: str
    check: str
    busy: bool


class VerdictReport(Message, frozen=True, kw_only=True):
    """The gate's verdict on the contract in frame `sequence`; None means accepted, and it runs."""

    sequence: int
    rejected: Rejected | None
    gate_s: float


class OutcomeReport(Message, frozen=True):
    """A contract is over."""

    outcome: Outcome
    binding: dict[str, int]


class SceneReport(Message, frozen=True, kw_only=True):
    """What a planner needs to know: the scene as perceived, the posture, what is held, the time [s]."""

    now: float
    scene: Scene
    q: tuple[float, ...]
    opening: float
    holding: str | None


class EventReport(Message, frozen=True):
    """An event of the flight log, for people."""

    t: float
    kind: str
    text: str
    data: dict[str, Any]


class TickReport(Message, frozen=True, kw_only=True):
    """Enough of a tick to draw it; `h_min` [m] is None where the input was refused and nothing was measured."""

    t: float
    scene: Scene
    q: tuple[float, ...]
    opening: float
    u: tuple[float, ...]
    delta: float
    h_min: float | None
    status: str
    barriers: tuple[str, ...]
    skill: str
    phase: str
    in_contract: bool
    order: str
    check: str


class RequestRefused(Message, frozen=True):
    """Why something was not taken; the connection may be closed after it."""

    reason: str


CLIENT_MESSAGES: tuple[type[Message], ...] = (Hello, Heartbeat, Propose, OperatorCommand, SceneRequest)
SERVER_MESSAGES: tuple[type[Message], ...] = (
    Challenge,
    Welcome,
    StatusReport,
    VerdictReport,
    OutcomeReport,
    SceneReport,
    EventReport,
    TickReport,
    RequestRefused,
)
_KIND_CODES: dict[type[Message], int] = {
    kind: code for code, kind in enumerate((*CLIENT_MESSAGES, *SERVER_MESSAGES), start=1)
}
_DECODERS = {code: msgspec.msgpack.Decoder(kind, strict=True) for kind, code in _KIND_CODES.items()}
_ENCODER = msgspec.msgpack.Encoder()
LAST_CLIENT_KIND = len(CLIENT_MESSAGES)


def kind_code(message: Message) -> int:
    """The code of a message's kind."""
    return _KIND_CODES[type(message)]


def encode_body(message: Message) -> bytes:
    """The body of a message's frame."""
    return _ENCODER.encode(message)


def decode_message(frame: Frame, *, from_client: bool) -> Message | str:
    """The message in `frame`, or why there is none; never raises, whatever the bytes."""
    if frame.kind not in _DECODERS or (frame.kind <= LAST_CLIENT_KIND) != from_client:
        return f"kind {frame.kind} is not spoken here"
    try:
        return _DECODERS[frame.kind].decode(frame.body)
    except (*DECODE_ERRORS, ValueError) as error:
        return f"kind {frame.kind}: {str(error)[:120]}"
