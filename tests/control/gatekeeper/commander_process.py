"""A commander in a separate process, which a test kills, stops or makes fail.

python commander_process.py SOCKET KEYS FAILURE        (FAILURE: flood, malformed, or any other word for none)
"""

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


def send_flood(client):
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


def send_malformed_bytes(client):
    """Send bytes that are not frames until the connection is closed."""
    with client._lock:
        try:
            for _ in range(2000):
                client._socket.sendall(bytes(range(256)) * 16)
        except OSError:
            return


def main(path, keys, failure):
    client = GatekeeperClient(Path(path), load_or_create_keys(Path(keys)), "planner")
    client.propose(contract_bytes(), client.request_scene().scene.version)
    sys.stdout.write("running\n")
    sys.stdout.flush()
    line = sys.stdin.readline()
    assert line
    if failure in ("flood", "malformed"):
        {"flood": send_flood, "malformed": send_malformed_bytes}[failure](client)
        sys.stdout.write("done\n")
        sys.stdout.flush()
    time.sleep(60.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
