"""Calls over MCP that are unusual: each has a result or a sentence with a remedy, and a stop overtakes all of them."""

import threading
import time
from contextlib import asynccontextmanager

import anyio
import anyio.to_thread
import httpx2
import pytest
from mcp.client.client import Client
from mcp.client.streamable_http import streamable_http_client
from mcp.shared.exceptions import MCPError

from dualbrain.agent_api.submission import SubmissionReport
from dualbrain.agent_api.tools import MAX_INSTRUCTION
from dualbrain.agent_server import mcp_server
from dualbrain.agent_server.access_control import AccessControl, AccessPolicy
from dualbrain.agent_server.mcp_server import LIST_TIME, make_mcp_server
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from tests.agent_server.stub_robot import StubRobot

PORT, TOKEN = 8765, "t" * 32
WAITS = 45
"""Number of waiting calls: more than the threads of the server."""
HANG_TIME = 5.0
"""Time after which a gatekeeper that hangs counts as lost [s]."""
LONG = "put the red cube in the bowl".ljust(MAX_INSTRUCTION) + " but only if it is empty"


class WaitingRobot(StubRobot):
    """A robot with a contract that runs, until `ended` is set."""

    def __init__(self):
        super().__init__()
        self.ended, self.lost, self.hangs = threading.Event(), False, False

    def outcome(self, submission_id="", *, timeout=0.0):
        if submission_id not in ("", "c-0001"):
            return None
        self.ended.wait(timeout)
        return SubmissionReport(id="c-0001", state="finished" if self.ended.is_set() else "running")

    def scene(self):
        self._require_connection()
        return super().scene()

    def schema(self, form="decoding"):
        self._require_connection()
        return super().schema(form)

    def _require_connection(self):
        if self.hangs:
            time.sleep(HANG_TIME)
        if self.lost or self.hangs:
            raise ConnectionLostError("the gatekeeper closed the connection")


@pytest.fixture(scope="module")
def kept():
    found = WaitingRobot()
    yield found
    found.cell.close()


@pytest.fixture
def robot(kept):
    kept.lost = kept.hangs = False
    kept.ended.clear()
    return kept


@asynccontextmanager
async def connection(robot):
    app = make_mcp_server(robot).streamable_http_app()
    protected = AccessControl(app, AccessPolicy(token=TOKEN, hosts=("127.0.0.1",), port=PORT))
    headers = {"Authorization": f"Bearer {TOKEN}"}
    http = httpx2.AsyncClient(transport=httpx2.ASGITransport(protected), headers=headers, timeout=30.0)
    transport = streamable_http_client(f"http://127.0.0.1:{PORT}/mcp", http_client=http)
    async with app.router.lifespan_context(app), Client(transport) as client:
        yield client


def use(robot, function):
    """The result of `function` with a client of `robot`."""

    async def run():
        async with connection(robot) as client:
            return await function(client)

    return anyio.run(run)


def refusal(robot, ask):
    """The message of the error that `ask` gets."""

    async def caught(client):
        with pytest.raises(MCPError) as raised:
            await ask(client)
        return str(raised.value)

    return use(robot, caught)


def call(robot, name, **arguments):
    result = use(robot, lambda client: client.call_tool(name, arguments))
    return result.structured_content


@pytest.mark.parametrize("wait", [{}, {"wait_s": 1}])
def test_an_unknown_id_is_a_result(wait, robot):
    found = call(robot, "get_outcome", id="c-9999", **wait)
    assert (found["state"], found["id"]) == ("unknown", "c-9999")


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"id": 10**400}, "id must be of type str"),
        ({"wait_s": "x"}, "wait_s must be of type"),
        ({"wait_s": True}, "wait_s"),
    ],
)
def test_an_argument_that_cannot_be_used_is_a_sentence(arguments, part, robot):
    assert part in call(robot, "get_outcome", **arguments)["error"]


def test_a_wait_of_any_length_is_bounded(robot):
    robot.ended.set()
    assert call(robot, "get_outcome", wait_s=10**400)["state"] == "finished"


def test_a_wait_ends_with_the_contract(robot):
    threading.Timer(1.0, robot.ended.set).start()
    started = time.monotonic()
    assert call(robot, "get_outcome", wait_s=20)["state"] == "finished"
    assert time.monotonic() - started < 5.0


def test_the_tools_are_listed_without_a_gatekeeper(robot):
    robot.lost = True
    tools = use(robot, lambda client: client.list_tools()).tools
    assert {"stop", "get_scene", "submit_contract"} <= {one.name for one in tools}


def test_the_first_call_to_a_gatekeeper_that_hangs_is_no_later_than_the_list_of_the_tools(robot):
    """The client lists the tools after its first call, to check the result."""

    async def stop(client):
        started = time.monotonic()
        result = await client.call_tool("stop", {})
        return result.structured_content, time.monotonic() - started

    robot.hangs = True
    stopped, duration = use(robot, stop)
    assert stopped["sent"]
    assert LIST_TIME < duration < HANG_TIME - 1.0


@pytest.mark.parametrize(
    "ask",
    [
        lambda client: client.read_resource("dualbrain://robot"),
        lambda client: client.read_resource("dualbrain://schema"),
        lambda client: client.get_prompt("plan", {"instruction": "go home"}),
    ],
    ids=["robot", "schema", "prompt"],
)
def test_a_robot_that_cannot_be_reached_is_a_sentence(ask, robot):
    robot.lost = True
    message = refusal(robot, ask)
    assert "cannot be reached: the gatekeeper closed the connection" in message
    assert "dualbrain doctor" in message


def test_a_long_instruction_is_refused_in_the_prompt(robot):
    message = refusal(robot, lambda client: client.get_prompt("plan", {"instruction": LONG}))
    assert f"has {len(LONG)} characters; at most {MAX_INSTRUCTION}" in message


@pytest.mark.parametrize("n_waiting", [WAITS, 70])
def test_a_stop_overtakes_every_waiting_call(n_waiting, robot):
    async def stop_beside_waits(client):
        async with connection(robot) as other, anyio.create_task_group() as group:
            for _ in range(n_waiting):
                group.start_soon(client.call_tool, "get_outcome", {"wait_s": 20})
            await anyio.sleep(1.0)
            started = time.monotonic()
            stopped = await other.call_tool("stop", {"emergency": True})
            duration = time.monotonic() - started
            group.cancel_scope.cancel()
        robot.ended.set()
        return stopped.structured_content, duration

    stopped, duration = use(robot, stop_beside_waits)
    assert stopped["sent"]
    assert duration < 2.0


def test_a_stop_overtakes_calls_that_hold_every_thread(robot):
    async def stop_beside_calls(client):
        async with anyio.create_task_group() as group:
            release = threading.Event()
            for _ in range(int(anyio.to_thread.current_default_thread_limiter().total_tokens) + 5):
                group.start_soon(anyio.to_thread.run_sync, release.wait, 10.0)
            await anyio.sleep(0.3)
            try:
                with anyio.fail_after(5.0):
                    return (await client.call_tool("stop", {})).structured_content
            finally:
                release.set()

    assert use(robot, stop_beside_calls)["sent"]


def test_beyond_the_bound_a_call_states_that_it_did_not_wait(robot, monkeypatch):
    monkeypatch.setattr(mcp_server, "MAX_WAITING", 0)
    found = call(robot, "get_outcome", wait_s=20)
    assert found["state"] == "running"
    assert "get_outcome" in found["note"]
