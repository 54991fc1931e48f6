"""Requests and replies between the control process and the gate process, and their packets.

A packet is one msgpack value. The control process encodes requests and decodes replies; it never parses a contract.
"""

from __future__ import annotations

from typing import Protocol

import msgspec

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.verdict import Rejected, Verdict
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.robot_link.packets import StatePacket
from dualbrain.records import Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.skills.skill import HeldObject


class GateRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A contract to be checked, as received, with `stamp`, its header, and the robot's state and scene at arrival.

    `now` is the robot's time [s]; the reply goes to connection `connection_number` for its frame `sequence`. A contract
    with `dry_run` is not executed: its header is not checked, and the gate's state does not change.
    """

    connection_number: int
    sequence: int
    contract: bytes
    stamp: ContractHeader
    now: float
    scene: Scene
    state: RobotState
    holding: HeldObject | None
    dry_run: bool = False


class GateReply(msgspec.Struct, frozen=True):
    """The gate's verdict on a request, and the time it took [s]."""

    request: GateRequest
    verdict: Verdict
    seconds: float


class ContractGate(Protocol):
    """Checks one contract at a time; the control tick submits it and collects the reply in a later tick."""

    @property
    def busy(self) -> bool:
        """Whether a contract is being checked, or its reply has not been taken."""
        ...

    def submit(self, request: GateRequest) -> bool:
        """Take a request, without waiting; returns False while another one is being checked."""
        ...

    def take_reply(self) -> GateReply | None:
        """The reply, or None while none is ready."""
        ...

    def close(self) -> None:
        """End the gate."""
        ...


class GateSetup(msgspec.Struct, frozen=True, kw_only=True):
    """The gate's robot, the capabilities by principal, and the fixed obstacles of the site."""

    robot_model: RobotModel
    capabilities: dict[str, Capability]
    fixed_obstacles: tuple[Obstacle, ...] = ()


class Ready(msgspec.Struct, frozen=True, tag=1):
    """The gate process can check contracts."""


class CheckPacket(msgspec.Struct, frozen=True, kw_only=True, tag=2):
    """A `GateRequest` without the fields that the gate does not need; `number` identifies it."""

    number: int
    contract: bytes
    stamp: ContractHeader
    now: float
    scene: Scene
    state: StatePacket
    holding: HeldObject | None
    dry_run: bool = False


class VerdictPacket(msgspec.Struct, frozen=True, kw_only=True, tag=3):
    """The verdict on request `number`, and the time it took [s]."""

    number: int
    verdict: Verdict
    seconds: float


FromGate = Ready | VerdictPacket
encode = msgspec.msgpack.Encoder().encode
decode_check = msgspec.msgpack.Decoder(CheckPacket).decode
_from_gate_decoder: msgspec.msgpack.Decoder[FromGate] = msgspec.msgpack.Decoder(FromGate)
decode_from_gate = _from_gate_decoder.decode


def encode_check(number: int, request: GateRequest) -> bytes:
    """The packet of `request`."""
    return encode(
        CheckPacket(
            number=number,
            contract=request.contract,
            stamp=request.stamp,
            now=request.now,
            scene=request.scene,
            state=StatePacket.from_state(request.state),
            holding=request.holding,
            dry_run=request.dry_run,
        )
    )


def request_of(packet: CheckPacket) -> GateRequest:
    """The request in a packet, with connection 0."""
    return GateRequest(
        connection_number=0,
        sequence=packet.number,
        contract=packet.contract,
        stamp=packet.stamp,
        now=packet.now,
        scene=packet.scene,
        state=packet.state.to_robot_state(),
        holding=packet.holding,
        dry_run=packet.dry_run,
    )


def gate_failure(problem: str) -> Rejected:
    """The rejection of a contract that the gate could not judge because of `problem`."""
    got = ascii(problem[:200])[1:-1]
    return Rejected(stage="envelope", pointer="", got=got, allowed="a verdict of the gate", hint="the gate failed")
