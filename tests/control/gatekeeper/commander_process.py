"""A commander in a process of its own, to be killed, stopped, or made to misbehave: `cortex.py SOCKET KEYS HOW`."""

import sys
import time
from pathlib import Path

import msgspec

from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperLink
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Heartbeat, encode_body, kind_of
from dualbrain.grounding.vocabulary import vocabulary

GRASP = {
    "object": "red_cube", "speed": 0.3, "clearance": 0.15, "finger_axis": "along", "opening": 0.08, "approach": "top",
    "wait": "none", "force": 20.0,
}  # fmt: skip
PLACE = {"destination": "blue_bowl", "speed": 0.3, "clearance": 0.15, "route": "direct", "wait": "none"}
ERRAND = (("grasp", GRASP), ("place", PLACE))


def contract(*actions, id="c-0001"):
    registry = vocabulary("panda")
    sequence = [{"skill": skill, "params": params} for skill, params in actions or ERRAND]
    context = {"robot": registry.robot, "registry": registry.hash}
    return msgspec.json.encode({"id": id, "context": context, "action_sequence": sequence})


def flood(link):
    """Well-formed heartbeats as fast as they go, until hung up on."""
    body, kind = encode_body(Heartbeat()), kind_of(Heartbeat())
    with link._lock:
        first = link._sent + 1
        link._link.settimeout(5.0)
        try:
            for start in range(first, first + 200_000, 200):
                link._link.sendall(b"".join(encode(kind, start + k, body) for k in range(200)))
        except OSError:
            return


def rubbish(link):
    with link._lock:
        try:
            for _ in range(2000):
                link._link.sendall(bytes(range(256)) * 16)
        except OSError:
            return


def main(path, keys, how):
    link = GatekeeperLink(Path(path), open_keys(Path(keys)), "planner")
    link.propose(contract(), link.look().scene.version)
    sys.stdout.write("running\n")
    sys.stdout.flush()
    line = sys.stdin.readline()
    assert line
    if how in ("flood", "rubbish"):
        {"flood": flood, "rubbish": rubbish}[how](link)
        sys.stdout.write("done\n")
        sys.stdout.flush()
    time.sleep(60.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
