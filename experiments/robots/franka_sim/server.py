"""The simulator as a process: it enforces the limits of motion, and does not abort for lost packets.

A machine that is not idle loses packets at 1 kHz. The simulator has one option for each kind of abort, so that a late
packet cannot be mistaken for a violated limit: `--enforce-motion-limits` and `--no-enforce-comm-constraints`.
"""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager

from experiments.robots.franka_sim.virtual_environment import ENVIRONMENT, model_file, server_command

ADDRESS, PORT = "127.0.0.1", 1337
"""The port of the Franka Control Interface, which the manufacturer's library does not let a caller choose."""
START_TIMEOUT = 120.0
"""[s]"""
OPTIONS = ("--enforce-motion-limits", "--no-enforce-comm-constraints", "--no-gripper")


@contextmanager
def running_server() -> Iterator[str]:
    """The address of a new simulator; one process at a time, because the port is fixed."""
    environment = {**os.environ, "FR3_MJCF": str(model_file())}
    with (ENVIRONMENT.folder / "lock").open("w") as lock, (ENVIRONMENT.folder / "server.log").open("wb") as log:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = subprocess.Popen([*server_command(), *OPTIONS], env=environment, stdout=log, stderr=log)
        try:
            _wait_until_ready(process)
            yield ADDRESS
        finally:
            process.terminate()
            process.wait(20.0)


def _wait_until_ready(process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((ADDRESS, PORT)) == 0:
                time.sleep(2.0)  # the server drops the probe, and prepares for the next client
                return
        time.sleep(0.5)
    raise TimeoutError(
        f"franka-sim did not listen within {START_TIMEOUT:.0f} s; see {ENVIRONMENT.folder / 'server.log'}"
    )
