"""Calls with contracts of every kind: none is accepted that the gate refuses as the same bytes."""

import json
import random

import pytest
from mcp.server.transport_security import TransportSecuritySettings
from starlette.testclient import TestClient

from dualbrain.agent_server.access_control import AccessControl, AccessPolicy
from dualbrain.agent_server.mcp_server import make_mcp_server
from dualbrain.contracts.verdict import Accepted
from dualbrain.skills.registry import skill_registry
from tests.agent_server.stub_robot import StubRobot

TOKEN, PORT, CALLS = "t" * 32, 8765, 300
META = {
    "io.modelcontextprotocol/protocolVersion": "2026-07-28",
    "io.modelcontextprotocol/clientInfo": {"name": "fuzz", "version": "1"},
    "io.modelcontextprotocol/clientCapabilities": {},
}
HEADERS = {
    "Authorization": f"Bearer {TOKEN}",
    "Accept": "application/json, text/event-stream",
    "Content-Type": "application/json",
    "MCP-Protocol-Version": "2026-07-28",
    "Mcp-Method": "tools/call",
}
TOKENS = ["\u2028", "\x00", "\\u0000", "1e999", "NaN", "null", "[" * 20, "x" * 70_000, "9" * 30, "{}", '"id":"c-0002",']
CHARACTERS = ' \t\n\ufeff\ud800\U0001f600"\\'
NUMBERS = ["0.50", "5e-1", "1e999", "-0.0", "500", "NaN", "0.5000000000000000000001", '"0.5"']
KEYS = ['"duration":0.5,"duration"', '"dura\\u0074ion"', '"Duration"']
WORDS = [('"hold"', '"throw"'), ('"c-0001"', '"c-1"'), ("panda", "ur5e"), ("[", "[[")]


@pytest.fixture(scope="module")
def robot():
    found = StubRobot()
    yield found
    found.cell.close()


@pytest.fixture
def client(robot):
    security = TransportSecuritySettings(enable_dns_rebinding_protection=False)
    app = make_mcp_server(robot).streamable_http_app(transport_security=security)
    policy = AccessPolicy(token=TOKEN, hosts=("127.0.0.1",), port=PORT)
    with TestClient(AccessControl(app, policy), base_url=f"http://127.0.0.1:{PORT}") as found:
        yield found


def call(client, tool, contract):
    """The result of a call whose contract is the text `contract`; None if the server refuses the message."""
    head = '{"jsonrpc":"2.0","id":1,"method":"tools/call","params":{"name":"' + tool + '","arguments":{"contract":'
    body = head + contract + '},"_meta":' + json.dumps(META) + "}}"
    reply = client.post("/mcp", headers=HEADERS | {"Mcp-Name": tool}, content=body.encode("utf-8", "surrogatepass"))
    return reply.json()["result"]["structuredContent"] if reply.status_code == 200 else None


def valid_contract(robot):
    registry = skill_registry(robot.cell.robot_model)
    steps = [{"skill": "hold", "params": {"duration": 0.5}}] * 2
    return robot.cell.contract(steps, "c-0001") | {"context": {"robot": registry.robot, "registry": registry.hash}}


def mutated(text, rng):
    """`text` with up to three changes of its characters, tokens or structure; sometimes unchanged."""
    for _ in range(rng.randint(0, 3)):
        place = rng.randrange(len(text))
        match rng.randrange(6):
            case 0:
                text = text[:place] + rng.choice(TOKENS) + text[place:]
            case 1:
                text = text[:place] + text[place + rng.randint(1, 4) :]
            case 2:
                text = text[:place] + rng.choice(CHARACTERS) + text[place:]
            case 3:
                text = text.replace("0.5", rng.choice(NUMBERS), 1)
            case 4:
                text = text.replace('"duration"', rng.choice(KEYS), 1)
            case _:
                text = text.replace(*rng.choice(WORDS))
    return text


def test_no_call_is_accepted_that_the_gate_refuses_as_the_same_bytes(client, robot):
    rng, accepted, answered = random.Random(7), 0, 0
    for number in range(CALLS):
        contract = mutated(json.dumps(valid_contract(robot)), rng)
        as_text = number % 4 == 0
        sent = json.dumps(contract) if as_text else contract
        result = call(client, rng.choice(["check_contract", "submit_contract"]), sent)
        answered += result is not None
        if result is not None and result.get("accepted"):
            data = contract.encode("utf-8", "surrogatepass")
            assert isinstance(robot.cell.check(data), Accepted), contract
            assert robot.checked[-1] == data
            accepted += 1
    assert accepted > CALLS // 20, "the test accepts too few contracts to mean anything"
    assert answered - accepted > CALLS // 4


def test_a_valid_contract_is_accepted_in_every_form(client, robot):
    contract = valid_contract(robot)
    for text in (json.dumps(contract), json.dumps(contract, indent=3), json.dumps(json.dumps(contract))):
        assert call(client, "check_contract", text) == {"accepted": True}


def test_the_client_is_recorded_as_the_author(client, robot):
    call(client, "submit_contract", json.dumps(valid_contract(robot)))
    assert robot.submitted[-1][1] == "mcp:fuzz"
