"""Two clients of one robot: a motion continues without its client, and another client sees its outcome."""

import anyio
import httpx2
import pytest
from mcp.client.client import Client
from mcp.client.streamable_http import streamable_http_client

from dualbrain import Robot
from dualbrain.agent_server.access_control import AccessControl, AccessPolicy
from dualbrain.agent_server.mcp_server import make_mcp_server

pytestmark = pytest.mark.realtime

PORT, TOKEN = 8765, "t" * 32


class Connections:
    """Opens clients of the server of `robot`."""

    def __init__(self, robot):
        self.app = make_mcp_server(robot).streamable_http_app()
        self._protected = AccessControl(self.app, AccessPolicy(token=TOKEN, hosts=("127.0.0.1",), port=PORT))

    def open(self):
        headers = {"Authorization": f"Bearer {TOKEN}"}
        http = httpx2.AsyncClient(transport=httpx2.ASGITransport(self._protected), headers=headers, timeout=30.0)
        return Client(streamable_http_client(f"http://127.0.0.1:{PORT}/mcp", http_client=http))


async def call(client, name, **arguments):
    return (await client.call_tool(name, arguments)).structured_content


async def use(robot):
    connections, hold = Connections(robot), [{"skill": "hold", "params": {"duration": 2.0}}]
    first, second = robot.contract(hold, "c-0001"), robot.contract(hold, "c-0002")
    async with connections.app.router.lifespan_context(connections.app), connections.open() as other:
        with anyio.move_on_after(0.6):
            async with connections.open() as leaving:
                await call(leaving, "submit_contract", contract=first)
        while (running := await call(other, "get_outcome"))["state"] == "checking":
            await anyio.sleep(0.02)
        busy = await call(other, "submit_contract", contract=second)
        again = await call(other, "submit_contract", contract=first)
    return running, busy, again


def test_a_motion_continues_without_its_client_and_excludes_the_contract_of_another(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))
    for _ in range(3):
        with Robot.simulated("panda", "bare:0") as robot:
            running, busy, again = anyio.run(use, robot)
        if again["outcome"]["kind"] not in ("stopped", "taken_over", "emergency"):  # of a machine that is too busy
            break
    assert (running["id"], running["state"]) == ("c-0001", "running")
    assert (busy["state"], busy["rejected"]["got"]) == ("rejected", "c-0001 is in progress")
    assert (again["repeated"], again["outcome"]["succeeded"]) == (True, True), again
