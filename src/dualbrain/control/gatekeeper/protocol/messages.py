"""Messages on the socket: strictly typed MessagePack; an unknown field, type or kind is refused.

A client sends `Hello`, `Heartbeat`, `Propose`, `OperatorCommand`, `SceneRequest`, `CheckRequest` and `CountsRequest`.
The gatekeeper sends `Challenge`, `Welcome`, `StatusReport`, `VerdictReport`, `OutcomeReport`, `SceneReport`,
`EventReport`, `TickReport`, `RequestRefused`, `CheckReport` and `CountsReport`. A contract is sent as raw bytes, which
only the gatekeeper's own gate parses.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.protocol.frames import Frame
from dualbrain.control.gatekeeper.timing.tick_counts import TickCounts
from dualbrain.errors import DECODE_ERRORS
from dualbrain.records import Outcome, Scene

OperatorAction = Literal[
    "pause", "resume", "abort", "takeover", "hand_back", "speed", "estop", "release_estop", "reset", "shut_down"
]
"""Commands of a person. Every client may send `estop`; release, reset, resume and speed need the operator's key."""


SceneVersion = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
"""Version of a scene, as the authentication code of a contract can represent it."""


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the messages."""


class Hello(Message, frozen=True, kw_only=True):
    """Authentication: `proof` is an HMAC over the challenge. An observer has no key (principal "", proof empty).

    `watch` requests event and tick reports.
    """

    principal: str
    proof: bytes
    watch: bool = False


class Heartbeat(Message, frozen=True):
    """The commander is alive."""


class Propose(Message, frozen=True, kw_only=True, rename={"mac": "seal"}):
    """A contract as raw bytes with its header; the authentication code `mac` covers all of it.

    `issued` and `expires` [s] are in the gatekeeper's time; the sequence number is that of the frame.
    """

    contract: bytes
    issued: float
    expires: float
    scene_version: SceneVersion
    mac: bytes


class OperatorCommand(Message, frozen=True, kw_only=True):
    """A command of a person; `speed` (0, 1] belongs to the action "speed"."""

    act: OperatorAction
    speed: float = 1.0


class SceneRequest(Message, frozen=True):
    """Request for a `SceneReport`."""


class CheckRequest(Message, frozen=True):
    """Request for the gate's verdict on a contract, as raw bytes, that is not executed."""

    contract: bytes


class CountsRequest(Message, frozen=True):
    """Request for a `CountsReport`; every role may send it.

    The counts are a message of their own and not a field of `StatusReport`, because a client of an older version
    refuses a message with a field that it does not know.
    """


class Challenge(Message, frozen=True):
    """First message of every connection: a fresh nonce, which also identifies the session."""

    nonce: bytes


class Welcome(Message, frozen=True, kw_only=True):
    """The role of the client; `now` [s] is the gatekeeper's time, `registry` the hash of its skill registry."""

    role: Literal["commander", "operator", "observer"]
    now: float
    robot: str
    registry: str


class StatusReport(Message, frozen=True, kw_only=True):
    """Periodic status: the gatekeeper's time [s], the supervisor's decision, and whether a contract runs.

    `commander` is whether a commander is connected.
    """

    now: float
    action: str
    cause: str
    check: str
    busy: bool
    commander: bool = False


class VerdictReport(Message, frozen=True, kw_only=True):
    """The gate's verdict on the contract in frame `sequence`; `rejected` is None if it was accepted and runs.

    `gate_s` is the time that the gate took [s].
    """

    sequence: int
    rejected: Rejected | None
    gate_s: float


class OutcomeReport(Message, frozen=True):
    """The outcome of a contract; `binding` counts the ticks in which each barrier was active."""

    outcome: Outcome
    binding: dict[str, int]


class SceneReport(Message, frozen=True, kw_only=True):
    """The perceived scene, the joint positions [rad], the finger opening [m] or None, the held object, the time [s]."""

    now: float
    scene: Scene
    q: tuple[float, ...]
    opening: float | None
    holding: str | None


class EventReport(Message, frozen=True):
    """An event of the flight log, for people."""

    t: float
    kind: str
    text: str
    data: dict[str, Any]


class TickReport(Message, frozen=True, kw_only=True):
    """One tick, for visualization; `h_min` [m] is None if the filter refused its input.

    `u` and `u_nom` [rad/s] are the control after and before the filter. `pairs` are the binding pairs with obstacles:
    link, obstacle, h [m].
    """

    t: float
    scene: Scene
    q: tuple[float, ...]
    opening: float | None
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
    u_nom: tuple[float, ...] = ()
    pairs: tuple[tuple[str, str, float], ...] = ()


class RequestRefused(Message, frozen=True):
    """The reason why a request was refused; the gatekeeper may close the connection afterwards."""

    reason: str


class CheckReport(Message, frozen=True, kw_only=True):
    """The gate's verdict on the contract of the `CheckRequest` in frame `sequence`, which had no effect.

    `rejected` is None if the gate would accept the contract now; `gate_s` is the time that the gate took [s]. With a
    reason in `refused`, the contract was not checked.
    """

    sequence: int
    rejected: Rejected | None = None
    gate_s: float = 0.0
    refused: str = ""


class CountsReport(Message, frozen=True):
    """The counts of all ticks since the start of the gatekeeper."""

    counts: TickCounts


_KIND_CODES: dict[type[Message], int] = {
    Hello: 1,
    Heartbeat: 2,
    Propose: 3,
    OperatorCommand: 4,
    SceneRequest: 5,
    Challenge: 6,
    Welcome: 7,
    StatusReport: 8,
    VerdictReport: 9,
    OutcomeReport: 10,
    SceneReport: 11,
    EventReport: 12,
    TickReport: 13,
    RequestRefused: 14,
    CheckRequest: 15,
    CheckReport: 16,
    CountsRequest: 17,
    CountsReport: 18,
}
"""Codes on the socket: fixed, so that a new kind changes no other one."""
CLIENT_MESSAGES: tuple[type[Message], ...] = (
    Hello,
    Heartbeat,
    Propose,
    OperatorCommand,
    SceneRequest,
    CheckRequest,
    CountsRequest,
)
SERVER_MESSAGES = tuple(kind for kind in _KIND_CODES if kind not in CLIENT_MESSAGES)
_DECODERS = {code: msgspec.msgpack.Decoder(kind, strict=True) for kind, code in _KIND_CODES.items()}
_ENCODER = msgspec.msgpack.Encoder()
_CLIENT_CODES = frozenset(_KIND_CODES[kind] for kind in CLIENT_MESSAGES)


def kind_code(message: Message) -> int:
    """The code of a message's kind."""
    return _KIND_CODES[type(message)]


def encode_body(message: Message) -> bytes:
    """The body of a message's frame."""
    return _ENCODER.encode(message)


def decode_message(frame: Frame, *, from_client: bool) -> Message | str:
    """The message in `frame`, or the reason why it is invalid; invalid bytes never raise."""
    if frame.kind not in _DECODERS or (frame.kind in _CLIENT_CODES) != from_client:
        return f"kind {frame.kind} is not known"
    try:
        return _DECODERS[frame.kind].decode(frame.body)
    except (*DECODE_ERRORS, ValueError) as error:
        return f"kind {frame.kind}: {str(error)[:120]}"
