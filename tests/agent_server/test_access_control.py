"""Requests without access: each has a declared status, and none reaches the application."""

import pytest
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from dualbrain.agent_server.access_control import AccessControl, AccessPolicy
from dualbrain.agent_server.contract_text import MAX_MESSAGE_BYTES

TOKEN = "t" * 32
PORT = 8765
GOOD = {"Authorization": f"Bearer {TOKEN}", "Host": f"127.0.0.1:{PORT}"}


@pytest.fixture
def received():
    return []


@pytest.fixture
def client(received):
    async def endpoint(request):
        received.append(await request.body())
        return PlainTextResponse("reached")

    app = Starlette(routes=[Route("/{path:path}", endpoint, methods=["GET", "POST"])])
    policy = AccessPolicy(
        token=TOKEN,
        hosts=("127.0.0.1", "localhost"),
        port=PORT,
        is_public=lambda path: path.startswith("/static/"),
        overview="The console is /console.",
    )
    return TestClient(AccessControl(app, policy), base_url=f"http://127.0.0.1:{PORT}")


@pytest.mark.parametrize(
    ("status", "headers"),
    [
        (401, {"Authorization": ""}),
        (401, {"Authorization": f"Bearer {TOKEN}x"}),
        (401, {"Authorization": f"Bearer  {TOKEN}"}),
        (401, {"Authorization": f"Basic {TOKEN}"}),
        (401, {"Authorization": f"Bearer {TOKEN.upper()}"}),
        (401, {"Authorization": TOKEN}),
        (421, {"Host": "example.org"}),
        (421, {"Host": "127.0.0.1:80"}),
        (421, {"Host": "127.0.0.1"}),
        (421, {"Host": f"127.0.0.1.example.org:{PORT}"}),
        (403, {"Origin": "http://example.org"}),
        (403, {"Origin": f"https://127.0.0.1:{PORT}"}),
        (403, {"Origin": "http://127.0.0.1:9"}),
        (403, {"Origin": "null"}),
    ],
)
def test_a_request_without_access_is_refused(status, headers, client, received):
    reply = client.post("/mcp", headers=GOOD | headers, content=b"{}")
    assert (reply.status_code, received) == (status, [])
    assert "error" in reply.json()
    if status == 401:
        assert reply.headers["WWW-Authenticate"].startswith("Bearer")


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Origin": f"http://127.0.0.1:{PORT}"},
        {"Host": f"localhost:{PORT}"},
        {"Authorization": f"bearer {TOKEN}"},  # the scheme is case-insensitive (RFC 9110, 11.1), the token is not
        {"Authorization": f"BEARER {TOKEN}"},
    ],
)
def test_a_request_with_access_passes(headers, client, received):
    assert client.post("/mcp", headers=GOOD | headers, content=b'{"a": 1}').text == "reached"
    assert received == [b'{"a": 1}']


def test_the_root_states_without_a_token_where_everything_is_and_refuses(client, received):
    host = {"Host": f"127.0.0.1:{PORT}"}
    root, other = client.get("/", headers=host, follow_redirects=False), client.get("/mcp", headers=host)
    assert (root.status_code, other.status_code, received) == (401, 401, [])
    assert root.json()["error"] == f"{other.json()['error']} The console is /console."
    assert "console" not in client.get("/", headers={"Host": "example.org"}).text


def test_a_body_that_is_too_long_is_refused_with_and_without_its_length(client, received):
    body = b"x" * (MAX_MESSAGE_BYTES + 1)
    assert client.post("/mcp", headers=GOOD, content=body).status_code == 413
    assert client.post("/mcp", headers=GOOD, content=iter([body[:9], body[9:]])).status_code == 413
    assert received == []


def test_a_public_file_needs_no_token_but_the_right_host(client, received):
    host = {"Host": f"127.0.0.1:{PORT}"}
    assert client.get("/static/page.html", headers=host).status_code == 200
    assert client.post("/static/page.html", headers=host).status_code == 401
    assert client.get("/static/page.html", headers={"Host": "example.org"}).status_code == 421
    assert len(received) == 1


def test_a_contract_in_a_message_of_mcp_is_passed_on_as_text_and_other_bodies_unchanged(client, received):
    body = b'{"params": {"arguments": {"contract": {"a": 1, "a": 2}}}}'
    client.post("/mcp", headers=GOOD, content=body)
    client.post("/console/api/check", headers=GOOD, content=body)
    assert received == [b'{"params":{"arguments":{"contract":"{\\"a\\": 1, \\"a\\": 2}"}}}', body]


@pytest.mark.parametrize(
    ("scheme", "port", "host", "authorities"),
    [
        ("https", 443, "robot.lab", ["robot.lab", "robot.lab:443"]),
        ("http", 80, "localhost", ["localhost", "localhost:80"]),
        ("https", 8765, "2001:db8::7", ["[2001:db8::7]:8765"]),
        ("https", 443, "2001:db8::7", ["[2001:db8::7]", "[2001:db8::7]:443"]),
        ("http", PORT, "[::1]", [f"[::1]:{PORT}"]),
        ("http", 443, "localhost", ["localhost:443"]),
    ],
)
def test_a_host_and_its_pages_have_access_with_and_without_the_default_port(scheme, port, host, authorities):
    policy = AccessPolicy(token=TOKEN, hosts=(host,), port=port, scheme=scheme)
    for authority in authorities:
        headers = {"host": authority, "origin": f"{scheme}://{authority}", "authorization": f"Bearer {TOKEN}"}
        assert policy.refusal("POST", "/console/api/stop", Headers(headers)) is None
    others = {host, f"[{host}]", f"{host}:{port}"} - {*authorities}
    for authority in others:
        refused = policy.refusal("POST", "/mcp", Headers({"host": authority, "authorization": f"Bearer {TOKEN}"}))
        assert refused is not None
        assert refused.status_code == 421
    other_scheme = {"http": "https", "https": "http"}[scheme]
    headers = {"host": authorities[0], "origin": f"{other_scheme}://{authorities[0]}"}
    refused = policy.refusal("POST", "/mcp", Headers(headers))
    assert refused is not None
    assert refused.status_code == 403


@pytest.mark.parametrize(
    ("host", "sent"),
    [
        ("Robot.Lab", "robot.lab"),
        ("robot.lab", "Robot.LAB"),
        ("2001:DB8:0::7", "[2001:db8::7]"),
        ("2001:db8:0::7", "[2001:DB8:0::7]"),
    ],
)
def test_a_host_name_is_case_insensitive_and_an_address_may_be_shortened(host, sent):
    """A browser writes the host of an address in lower case, and an IPv6 address in its short form."""
    policy = AccessPolicy(token=TOKEN, hosts=(host,), port=PORT, scheme="https")
    headers = {"host": f"{sent}:{PORT}", "origin": f"https://{sent}:{PORT}", "authorization": f"Bearer {TOKEN}"}
    assert policy.refusal("POST", "/mcp", Headers(headers)) is None
    refused = policy.refusal("POST", "/mcp", Headers(headers | {"host": f"x{sent}:{PORT}"}))
    assert refused is not None
    assert refused.status_code == 421


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32-le", "utf-8-sig", "latin-1"])
def test_a_message_of_mcp_in_another_encoding_than_utf8_is_refused(encoding, client, received):
    body = '{"params": {"arguments": {"contract": {"a": "é", "a": 2}}}}'.encode(encoding)
    reply = client.post("/mcp", headers=GOOD, content=body)
    assert (reply.status_code, received) == (400, [])
    assert "UTF-8" in reply.json()["error"]
