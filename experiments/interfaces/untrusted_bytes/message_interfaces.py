"""Frames and messages of the gatekeeper, packets of the robot and of the gate process, requests to the live view."""

from __future__ import annotations

from email.message import Message as Headers

import msgspec
import numpy as np

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER, check_header
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.control.gatekeeper.gate.exchange import GateRequest
from dualbrain.control.gatekeeper.gatekeeper import MAX_CONTRACT_LIFETIME
from dualbrain.control.gatekeeper.operator_commands import OperatorCommands
from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder
from dualbrain.control.gatekeeper.protocol.frames import encode as encode_frame
from dualbrain.control.gatekeeper.protocol.messages import (
    Hello,
    Message,
    OperatorCommand,
    Propose,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.control.gatekeeper.robot_link import packets
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket, socket_pair
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.state_monitor import StateMonitor
from dualbrain.visualization.live.connection_guard import refuse_request
from experiments.interfaces.untrusted_bytes.interface import (
    ALWAYS_REFUSED,
    ByteInterface,
    Surprise,
    mutator_of_value,
    refuse_if,
    require_usable,
)
from experiments.interfaces.untrusted_bytes.mutation import HIDDEN_TEXTS, VALID, mutate_bytes

TYPED = ALWAYS_REFUSED | {"truncated"}
PORT = 8080


def message_interfaces(request: GateRequest) -> dict[str, ByteInterface]:
    """Interfaces by name."""
    return _frames() | _packets(request) | {"request to the live view": _live_view()}


def _frames() -> dict[str, ByteInterface]:
    """Client messages in frames: one that is not valid is refused, and the next frame of a stream is not lost."""
    found: dict[str, ByteInterface] = {}
    for message in (
        Propose(contract=b"{}", issued=0.5, expires=60.5, scene_version=1, mac=b"m" * 32),
        OperatorCommand(act="speed", speed=0.5),
        Hello(principal="planner", proof=b"p" * 32),
    ):
        kind = kind_code(message)

        def read(data: bytes) -> None:
            decoder = FrameDecoder()
            for start in range(0, len(data), 5000):
                decoder.feed(data[start : start + 5000])
            frame = decoder.next_frame()
            refuse_if(frame is None, "the frame is not complete")
            refuse_if(isinstance(frame, BrokenStream), frame)
            decoded = decode_message(frame, from_client=True)  # type: ignore[arg-type]
            refuse_if(isinstance(decoded, str), decoded)
            _obey(decoded)  # type: ignore[arg-type]

        encoding = msgspec.msgpack.decode(encode_body(message))
        found[f"frame of {type(message).__name__}"] = ByteInterface(
            mutate=mutator_of_value(encoding, lambda body, kind=kind: encode_frame(kind, 1, body)),
            read=read,
            refuses=TYPED - {"infinite"} if isinstance(message, Propose) else TYPED,  # a lifetime is cut to its limit
        )
    return found


def _obey(message: Message) -> None:
    """Take a message as the gatekeeper does: the numbers of a header and of a command are compared with their range."""
    if isinstance(message, Propose):
        header = ContractHeader(
            sequence=1,
            issued=message.issued,
            expires=min(message.expires, message.issued + MAX_CONTRACT_LIFETIME),
            principal=PLANNER,
            scene_version=message.scene_version,
        )
        names = SceneNames(version=1)
        refuse_if(check_header(header, principal=PLANNER, now=1.0, names=names, last_sequence=None))
        require_usable(header)
    elif isinstance(message, OperatorCommand):
        commands = OperatorCommands()
        refuse_if(commands.apply(message))
        require_usable(commands.speed_scale)
    else:
        require_usable(message)


def _packets(request: GateRequest) -> dict[str, ByteInterface]:
    robot_model = load_robot("panda")
    safety = SafetyFilter(robot_model)
    ours, theirs = socket_pair()
    sender = PacketSocket(ours, packets.decode_to_robot)
    receiver = PacketSocket(theirs, packets.decode_from_robot)
    rest = np.zeros(robot_model.n)

    def received(data: bytes) -> packets.FromRobot:
        refuse_if(len(data) > packets.MAX_PACKET_BYTES or not data, "a packet of this length is not sent")
        sender._socket.send(data)
        packet = receiver.receive()
        refuse_if(packet is None or isinstance(packet, MalformedPacket), packet)
        return packet  # type: ignore[return-value]

    def state(data: bytes) -> None:
        packet = received(data)
        refuse_if(not isinstance(packet, packets.StatePacket), packet)
        robot_state = packet.to_robot_state()  # type: ignore[union-attr]
        flags = StateMonitor(robot_model).check_state(robot_state, request.state.stamp)
        refuse_if(flags & Condition.STATE_IMPLAUSIBLE, "the state is not plausible")
        result = safety.filter(robot_state, rest, request.state.stamp)
        if not np.isfinite(result.u).all():
            raise Surprise("the control is not finite")
        refuse_if(not result.certified, result.status)
        require_usable(packet)

    def scene(data: bytes) -> None:
        packet = received(data)
        refuse_if(not isinstance(packet, packets.ScenePacket), packet)
        try:
            safety.observe(obstacles_from_scene(packet.scene, known=(), held=None))  # type: ignore[union-attr]
        finally:
            safety.observe(())

    values = {
        "state packet": (packets.encode(packets.StatePacket.from_state(request.state)), state),
        "scene packet": (packets.encode(packets.ScenePacket(request.scene)), scene),
    }
    return {
        name: ByteInterface(
            mutate=mutator_of_value(msgspec.msgpack.decode(data)),
            read=read,
            refuses=TYPED if name == "state packet" else frozenset({"deep", "truncated", "compressed", "no bytes"}),
        )
        for name, (data, read) in values.items()
    }


def _live_view() -> ByteInterface:
    own = {"Host": f"localhost:{PORT}", "Origin": f"http://localhost:{PORT}", "Sec-Fetch-Site": "same-origin"}

    def mutate(kind: str, rng: np.random.Generator) -> bytes | None:
        fields = dict(own)
        name = list(fields)[int(rng.integers(3))]
        if kind in ("truncated", "compressed"):
            fields[name] = mutate_bytes(kind, fields[name].encode(), rng).decode("latin-1")
        elif kind != VALID:
            fields[name] = _BAD_FIELDS[kind][int(rng.integers(len(_BAD_FIELDS[kind])))]
        return msgspec.json.encode(fields)

    def read(data: bytes) -> None:
        headers = Headers()
        for name, value in msgspec.json.decode(data).items():
            headers[name] = value
        refuse_if(refuse_request(_Fields(headers), PORT))

    return ByteInterface(mutate=mutate, read=read, refuses=frozenset(_BAD_FIELDS) | {"truncated", "compressed"})


class _Fields:
    def __init__(self, headers: Headers) -> None:
        self._headers = headers

    def get_all(self, key: str, /) -> list[str]:
        return [str(value) for value in self._headers.get_all(key) or []]


_BAD_FIELDS: dict[str, tuple[str, ...]] = {
    "nan": ("nan", "null"),
    "infinite": ("inf",),
    "denormal": ("localhost:5e-324",),
    "negative": (f"localhost:-{PORT}", f"http://localhost:-{PORT}"),
    "huge": ("localhost:" + "9" * 400, "localhost:99999"),
    "empty": (" ",),
    "no bytes": ("",),
    "wrong type": ("https://localhost", "file://", "evil.example", f"http://evil.example:{PORT}", "cross-site"),
    "wrong shape": (
        f"localhost:{PORT},localhost:{PORT}",
        f"localhost:{PORT}/",
        f"localhost.:{PORT}",
        f"a@localhost:{PORT}",
    ),
    "deep": ("[" * 600, "localhost." * 600),
    "long": ("x" * 100_000,),
    "unicode": (*(f"localhost{text}:{PORT}" for text in HIDDEN_TEXTS if text.isprintable()), f"l\u043ecalhost:{PORT}"),
}
