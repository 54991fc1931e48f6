"""Each protocol version over each transport, in raw messages: handshake, tools, a verdict, other versions."""

import json
import os
from threading import Thread
from types import SimpleNamespace

import pytest
from mcp.server.transport_security import TransportSecuritySettings
from starlette.testclient import TestClient

from dualbrain.agent_server.access_control import AccessControl, AccessPolicy
from dualbrain.agent_server.mcp_server import make_mcp_server
from dualbrain.agent_server.stdio_server import serve_stdio
from tests.agent_server.stub_robot import StubRobot
from tests.agent_server.test_fuzzed_calls import valid_contract

HANDSHAKE_VERSIONS, MODERN, UNKNOWN = ("2025-06-18", "2025-11-25"), "2026-07-28", "2031-01-01"
PREFIX = "io.modelcontextprotocol/"
ABOUT = {"name": "raw", "version": "1"}
TOKEN, PORT = "t" * 32, 8765
UNSUPPORTED_VERSION, INVALID_REQUEST = -32022, -32600


class RawClient:
    """A client that writes its messages itself; `exchange` sends one and returns the reply, None for a notification."""

    version = ""

    def request(self, method, **params):
        """The reply to a request, with the envelope of the modern protocol if that version is in use."""
        if self.version not in ("", *HANDSHAKE_VERSIONS):
            params["_meta"] = envelope(self.version)
        return self.exchange({"id": 1, "method": method, "params": params})

    def open(self, version):
        """The reply to the handshake of `version`, which is in use afterwards."""
        reply = self.request("initialize", protocolVersion=version, capabilities={}, clientInfo=ABOUT)
        self.version = reply["result"]["protocolVersion"]
        self.exchange({"method": "notifications/initialized"})
        return reply["result"]


class StdioClient(RawClient):
    def __init__(self, descriptors):
        self._input, self._output = os.fdopen(descriptors[0], "rb"), os.fdopen(descriptors[1], "wb")

    def exchange(self, message):
        self._output.write(json.dumps({"jsonrpc": "2.0"} | message).encode() + b"\n")
        self._output.flush()
        return json.loads(self._input.readline()) if "id" in message else None

    def close(self):
        self._output.close()
        self._input.close()


class HttpClient(RawClient):
    def __init__(self, client):
        self._client, self._session = client, {}

    def exchange(self, message):
        headers = {"Authorization": f"Bearer {TOKEN}", "Accept": "application/json, text/event-stream", **self._session}
        if self.version:
            headers["MCP-Protocol-Version"] = self.version
        if "_meta" in message.get("params", {}):
            headers |= {"Mcp-Method": message["method"], "Mcp-Name": message["params"].get("name", "")}
        reply = self._client.post("/mcp", headers=headers, json={"jsonrpc": "2.0"} | message)
        if "mcp-session-id" in reply.headers:
            self._session = {"Mcp-Session-Id": reply.headers["mcp-session-id"]}
        if "id" not in message:
            assert reply.status_code == 202
            return None
        events = [line[6:] for line in reply.text.splitlines() if line.startswith("data: {")]
        return json.loads(events[-1] if events else reply.text)


def envelope(version):
    return {f"{PREFIX}protocolVersion": version, f"{PREFIX}clientInfo": ABOUT, f"{PREFIX}clientCapabilities": {}}


def talk_over_stdio(robot, conversation):
    """The result of `conversation` with a server whose input closes afterwards."""
    (server_input, client_output), (client_input, server_output) = os.pipe(), os.pipe()
    raw, results = StdioClient((client_input, client_output)), []

    def talk():
        try:
            results.append(conversation(raw))
        finally:
            raw.close()

    client = Thread(target=talk)
    client.start()
    serve_stdio(make_mcp_server(robot), SimpleNamespace(input=server_input, output=server_output))
    client.join()
    os.close(server_input)
    os.close(server_output)
    return results[0]


def talk_over_http(robot, conversation):
    security = TransportSecuritySettings(enable_dns_rebinding_protection=False)
    app = make_mcp_server(robot).streamable_http_app(transport_security=security)
    policy = AccessPolicy(token=TOKEN, hosts=("127.0.0.1",), port=PORT)
    with TestClient(AccessControl(app, policy), base_url=f"http://127.0.0.1:{PORT}") as client:
        return conversation(HttpClient(client))


@pytest.fixture(scope="module")
def robot():
    found = StubRobot()
    yield found
    found.cell.close()


@pytest.fixture(params=[talk_over_stdio, talk_over_http], ids=["stdio", "http"])
def talk(request, robot):
    return lambda conversation: request.param(robot, conversation)


def use_tools(raw, robot):
    """The results of a list of the tools and of two checks, a valid contract and an invalid one."""
    good, bad = valid_contract(robot), valid_contract(robot) | {"action_sequence": []}
    requests = [("tools/list", {})]
    requests += [("tools/call", {"name": "check_contract", "arguments": {"contract": one}}) for one in (good, bad)]
    return [raw.request(method, **params)["result"] for method, params in requests]


def check_tools(results):
    listed, good, bad = results
    names = [one["name"] for one in listed["tools"]]
    assert names == ["get_scene", "get_schema", "check_contract", "submit_contract", "get_outcome", "stop"]
    assert good["structuredContent"] == {"accepted": True}
    assert (bad["structuredContent"]["accepted"], bad["structuredContent"]["stage"]) == (False, "syntax")


@pytest.mark.parametrize("version", HANDSHAKE_VERSIONS)
def test_a_version_with_a_handshake_is_negotiated_and_served(version, talk, robot):
    opened, results = talk(lambda raw: (raw.open(version), use_tools(raw, robot)))
    assert (opened["protocolVersion"], opened["serverInfo"]["name"]) == (version, "dualbrain")
    check_tools(results)
    assert not any("resultType" in one for one in results)


def test_the_version_without_a_handshake_is_served(talk, robot):
    def conversation(raw):
        raw.version = MODERN
        return raw.request("server/discover")["result"], use_tools(raw, robot)

    about, results = talk(conversation)
    assert about["supportedVersions"] == [MODERN]
    check_tools(results)
    assert {one["resultType"] for one in results} == {"complete"}


def test_a_handshake_with_an_unknown_version_gets_the_newest_one_that_has_a_handshake(talk, robot):
    opened, results = talk(lambda raw: (raw.open(UNKNOWN), use_tools(raw, robot)))
    assert opened["protocolVersion"] == HANDSHAKE_VERSIONS[-1]
    check_tools(results)


def test_a_request_of_an_unknown_version_is_refused_with_the_known_ones(talk, robot):
    def conversation(raw):
        raw.version = UNKNOWN
        return raw.request("tools/call", name="stop", arguments={})

    stops = len(robot.stops)
    error = talk(conversation)["error"]
    assert error["code"] == UNSUPPORTED_VERSION
    assert error["data"] == {"supported": [MODERN], "requested": UNKNOWN}
    assert len(robot.stops) == stops


@pytest.mark.parametrize("first", [HANDSHAKE_VERSIONS[-1], MODERN])
def test_one_stream_keeps_the_generation_of_the_protocol_with_which_it_began(first, robot):
    def conversation(raw):
        if first == MODERN:
            raw.version = MODERN
            raw.request("tools/list")
            raw.version = ""
            return raw.request("initialize", protocolVersion=HANDSHAKE_VERSIONS[0], capabilities={}, clientInfo=ABOUT)
        raw.open(first)
        raw.version = MODERN
        return raw.request("tools/list")

    code = talk_over_stdio(robot, conversation)["error"]["code"]
    assert code == (UNSUPPORTED_VERSION if first == MODERN else INVALID_REQUEST)
