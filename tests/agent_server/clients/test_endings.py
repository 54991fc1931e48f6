"""The end of a server, of each kind and during a contract: gatekeeper and robot end with it."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.agent_server.clients.test_clients import COMMAND, environment  # noqa: F401  (a fixture)

pytestmark = pytest.mark.realtime

END_TIME = 2.0
"""Longest time [s] until server, gatekeeper and robot have ended."""


def processes(environment):  # noqa: F811
    """The processes that were started with the data folder of the test."""
    mark = f"DUALBRAIN_HOME={environment['DUALBRAIN_HOME']}".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


class StdioServer:
    """A server whose messages the test writes itself, in the older generation of the protocol."""

    def __init__(self, environment):  # noqa: F811
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen(COMMAND, env=environment, **pipes)
        about = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "t", "version": "1"}}
        self.request("initialize", about)
        self.send({"method": "notifications/initialized"})

    def send(self, message):
        self.process.stdin.write(json.dumps({"jsonrpc": "2.0"} | message).encode() + b"\n")
        self.process.stdin.flush()

    def request(self, method, params):
        self.send({"id": 1, "method": method, "params": params})
        while (reply := json.loads(self.process.stdout.readline())).get("id") != 1:
            pass
        return reply["result"]

    def move(self):
        """Begin a contract of several seconds."""
        scene = self.request("tools/call", {"name": "get_scene", "arguments": {}})["structuredContent"]
        contract = {
            "id": scene["next_id"],
            "context": {"robot": "panda", "registry": scene["registry"]},
            "action_sequence": [{"skill": "hold", "params": {"duration": 9.0}}],
        }
        call = {"name": "submit_contract", "arguments": {"contract": contract, "wait_s": 0}}
        assert self.request("tools/call", call)["structuredContent"]["state"] == "running"


@pytest.mark.parametrize("end", ["closed input", pytest.param("SIGTERM", marks=pytest.mark.slow), "SIGKILL"])
def test_gatekeeper_and_robot_end_with_the_server(end, environment):  # noqa: F811
    server = StdioServer(environment)
    try:
        server.move()
        assert len(processes(environment)) >= 3
        started = time.monotonic()
        if end == "closed input":
            server.process.stdin.close()
        else:
            os.kill(server.process.pid, getattr(signal, end))
        while processes(environment) and time.monotonic() - started < 10.0:
            time.sleep(0.01)
        assert time.monotonic() - started < END_TIME
    finally:
        server.process.kill()
        server.process.wait()
        for pipe in (server.process.stdin, server.process.stdout):
            pipe.close()
