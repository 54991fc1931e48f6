"""A commander in a separate process, which a test kills, stops or makes fail.

python commander_process.py SOCKET KEYS FAILURE        (FAILURE: flood, malformed, or any other word for none)
"""

import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT))

from dualbrain.control.gatekeeper.protocol.authentication import load_keys  # noqa: E402
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient  # noqa: E402
from experiments.gatekeeper.commander_messages import contract_bytes, send_flood, send_malformed_bytes  # noqa: E402


def main(path, keys, failure):
    client = GatekeeperClient(Path(path), load_keys(Path(keys), ("planner",)), "planner")
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
