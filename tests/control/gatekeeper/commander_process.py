"""A commander in a process of its own, to be killed, stopped, or made to misbehave: `cortex.py SOCKET KEYS HOW`."""

import sys
import time
from pathlib import Path

import msgspec

from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Heartbeat, encode_body, kind_code
from dualbrain.grounding.vocabulary import load_skill_registry

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
PICK_AND_PLACE = (("grasp", GRASP), ("place", PLACE))


def contract_bytes(*actions, id="c-0001"):
    registry = load_skill_registry("panda")
    sequence = [{"skill": skill, "params": params} for skill, params in actions or PICK_AND_PLACE]
    context = {"robot": registry.robot, "registry": registry.hash}
    return msgspec.json.encode({"id": id, "context": context, "action_sequence": sequence})


def send_flood(link):
    """Well-formed heartbeats as fast as they go, until hung up on."""
    body, kind = encode_body(Heartbeat()), kind_code(Heartbeat())
    with link._lock:
        first = link._sent + 1
        link._link.settimeout(5.0)
        try:
            for start in range(first, first + 200_000, 200):
                link._link.sendall(b"".join(encode(kind, start + k, body) for k in range(200)))
        except OSError:
            return


def send_malformed_bytes(link):
    with link._lock:
        try:
            for _ in range(2000):
                link._link.sendall(bytes(range(256)) * 16)
        except OSError:
            return


def main(path, keys, how):
    link = GatekeeperClient(Path(path), load_or_create_keys(Path(keys)), "planner")
    link.propose(contract_bytes(), link.request_scene().scene.version)
    sys.stdout.write("running\n")
    sys.stdout.flush()
    line = sys.stdin.readline()
    assert line
    if how in ("flood", "rubbish"):
        {"flood": send_flood, "rubbish": send_malformed_bytes}[how](link)
        sys.stdout.write("done\n")
        sys.stdout.flush()
    time.sleep(60.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
