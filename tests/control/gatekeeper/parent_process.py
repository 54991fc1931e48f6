"""A parent of a gatekeeper in a separate process, which a test ends in any way and at any moment.

python parent_process.py FOLDER        (prints `started PID`, then `running` once the arm executes a contract)
"""

import os
import sys
import time
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT))

from dualbrain.control.gatekeeper import process as process_module  # noqa: E402
from dualbrain.control.gatekeeper.config import GatekeeperConfig  # noqa: E402
from dualbrain.control.gatekeeper.process import GatekeeperProcess, start_child  # noqa: E402
from dualbrain.control.gatekeeper.protocol.authentication import load_keys  # noqa: E402
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient  # noqa: E402
from dualbrain.simulation.scenes.generators.catalogue import open_scene  # noqa: E402
from experiments.gatekeeper.commander_messages import contract_bytes  # noqa: E402


def print_line(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def start(*arguments, **options):
    child = start_child(*arguments, **options)
    if os.fork() == 0:  # a process that inherits the write end of the pipe, as a careless library may start one
        os.closerange(1, 3)
        time.sleep(30.0)
        os._exit(0)
    print_line(f"started {child.pid}")
    return child


def main(folder):
    config = GatekeeperConfig(
        robot="panda",
        scene=open_scene("bare:0"),
        socket=str(folder / "s"),
        keys=str(folder / "keys"),
        report=str(folder / "robot.json"),
        recording=str(folder / "ticks.mcap"),
    )
    with patch.object(process_module, "start_child", start):
        GatekeeperProcess(config)
    client = GatekeeperClient(folder / "s", load_keys(folder / "keys", ("planner",)), "planner")
    client.propose(contract_bytes(), client.request_scene().scene.version)
    print_line("running")
    time.sleep(60.0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
