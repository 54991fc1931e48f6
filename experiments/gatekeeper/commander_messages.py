"""Messages of a commander: a pick and place for the Panda, and the floods and malformed bytes of one that fails."""

from __future__ import annotations

from typing import Any

import msgspec

from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Heartbeat, encode_body, kind_code
from dualbrain.grounding.vocabulary import load_skill_registry

SkillCall = tuple[str, dict[str, Any]]
"""A skill and its parameters."""

GRASP = {
    "object": "red_cube",
    "speed": 0.3,
    "clearance": 0.15,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 20.0,
}
PLACE = {"destination": "blue_bowl", "speed": 0.3, "clearance": 0.15, "route": "direct", "wait": "none"}
PICK_AND_PLACE: tuple[SkillCall, ...] = (("grasp", GRASP), ("place", PLACE))


def contract_bytes(*actions: SkillCall, id: str = "c-0001") -> bytes:
    """A contract of `actions`, by default `PICK_AND_PLACE`."""
    registry = load_skill_registry("panda")
    sequence = [{"skill": skill, "params": params} for skill, params in actions or PICK_AND_PLACE]
    context = {"robot": registry.robot, "registry": registry.hash}
    return msgspec.json.encode({"id": id, "context": context, "action_sequence": sequence})


def send_flood(client: GatekeeperClient) -> None:
    """Send well-formed heartbeats as fast as possible until the connection is closed."""
    body, kind = encode_body(Heartbeat()), kind_code(Heartbeat())
    with client._lock:
        first = client._sent + 1
        client._socket.settimeout(5.0)
        try:
            for start in range(first, first + 200_000, 200):
                client._socket.sendall(b"".join(encode(kind, start + k, body) for k in range(200)))
        except OSError:
            return


def send_malformed_bytes(client: GatekeeperClient) -> None:
    """Send bytes that are not frames until the connection is closed."""
    with client._lock:
        try:
            for _ in range(2000):
                client._socket.sendall(bytes(range(256)) * 16)
        except OSError:
            return
