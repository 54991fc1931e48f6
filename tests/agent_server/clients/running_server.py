"""A server over stdio or HTTP as a process, whose messages the test writes itself, and the processes it started."""

import json
import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import httpx2

from tests.agent_server.clients.test_clients import COMMAND, free_port

MOTION = [
    {
        "skill": "move_to",
        "params": {"target": "blue_bowl", "speed": 0.1, "clearance": 0.2, "route": "direct", "wait": "none"},
    }
]
"""A motion of several seconds in scene 8."""


def start_ticks(pid):
    """The state of a process, and its start, which distinguishes it from a later one with its number."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return fields[0], fields[19]


class RunningServer:
    """A server that is ready; its processes are those with the data folder of the test."""

    def __init__(self, environment, *arguments):
        self.home = f"DUALBRAIN_HOME={environment['DUALBRAIN_HOME']}".encode()
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen([*COMMAND, *arguments], env=environment, **pipes)
        for line in self.process.stderr:
            if b"is ready" in line:
                return
        raise AssertionError("the server did not start")

    def begin_motion(self):
        """Begin a contract that moves the arm, and wait until it moves."""
        scene = self.call("get_scene", {})
        context = {"robot": "panda", "registry": scene["registry"]}
        contract = {"id": scene["next_id"], "context": context, "action_sequence": MOTION}
        assert self.call("submit_contract", {"contract": contract, "wait_s": 0})["state"] == "running"
        time.sleep(0.5)

    def family(self):
        """Number and start of server, gatekeeper, gate and robot."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if self.home in (folder / "environ").read_bytes().split(b"\0"):
                    found[int(folder.name)] = start_ticks(int(folder.name))[1]
        return found

    def end(self, how):
        """Close the input, or send a signal."""
        if how == "closed input":
            self.process.stdin.close()
        else:
            self.process.send_signal(getattr(signal, how))

    def close(self):
        """Kill what remains."""
        for pid in running(self.family()):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            pipe.close()


class StdioServer(RunningServer):
    """Over stdin and stdout, in the older generation of the protocol."""

    def __init__(self, environment, *arguments):
        super().__init__(environment, *arguments)
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

    def call(self, name, arguments):
        return self.request("tools/call", {"name": name, "arguments": arguments})["structuredContent"]


class HttpServer(RunningServer):
    """Over Streamable HTTP, in the newest generation of the protocol; the console's event stream stays open."""

    def __init__(self, environment, *arguments):
        self.url = f"http://127.0.0.1:{(port := free_port())}"
        self.client = httpx2.Client(headers={"Authorization": f"Bearer {environment['DUALBRAIN_TOKEN']}"}, timeout=60)
        super().__init__(environment, "--http", str(port), *arguments)
        self.stream = self.client.send(self.client.build_request("GET", f"{self.url}/console/api/events"), stream=True)

    def call(self, name, arguments):
        prefix, version = "io.modelcontextprotocol/", "2026-07-28"
        about = {"protocolVersion": version, "clientInfo": {"name": "t", "version": "1"}, "clientCapabilities": {}}
        meta = {prefix + key: value for key, value in about.items()}
        headers = {"Accept": "application/json, text/event-stream", "MCP-Protocol-Version": version}
        headers |= {"Mcp-Method": "tools/call", "Mcp-Name": name}
        params = {"name": name, "arguments": arguments, "_meta": meta}
        body = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": params}
        reply = self.client.post(f"{self.url}/mcp", headers=headers, json=body)
        return reply.json()["result"]["structuredContent"]

    def close(self):
        super().close()
        self.stream.close()
        self.client.close()


def running(family):
    """The numbers of the processes that have not ended, whether their parents have collected them or not."""
    left = []
    for pid, start in family.items():
        with suppress(OSError):
            state, now = start_ticks(pid)
            if now == start and state not in "ZX":
                left.append(pid)
    return left
