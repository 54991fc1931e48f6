"""Requests to the console: who has access, which rights it has, and what its answers contain."""

import json
import os
import shutil
import socket
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import msgspec
import pytest
from starlette.routing import Route

from dualbrain.agent_api.saved_runs import SavedRuns
from dualbrain.agent_api.tools import verdict_view
from dualbrain.agent_server.console import run_list
from dualbrain.agent_server.console.console_robot import ConsoleRobot
from dualbrain.agent_server.console.report_tickets import LIFETIME, MAX_TICKETS, ReportTickets
from dualbrain.agent_server.console.routes import console_routes, is_public
from dualbrain.agent_server.console.run_list import list_runs, read_report
from dualbrain.contracts.gate.strict_json import MAX_BYTES
from dualbrain.control.recording.trace import Event
from dualbrain.core.untrusted.bounded_file import FileRefusal
from dualbrain.records import Passage, RetrievedContext
from dualbrain.robots.loader import load_robot
from tests.agent_server.console.console_server import REGISTRY, TOKEN, ConsoleServer, FakeRobot, serve_console
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_ledger, open_memory

STATIC = Path(__file__).parents[3] / "src/dualbrain/agent_server/console/static"
HIDDEN = "red\u202ecube\u200b"
SECURITY = {"x-content-type-options": "nosniff", "referrer-policy": "no-referrer", "cache-control": "no-store"}


@pytest.fixture(scope="module")
def console(tmp_path_factory):
    with serve_console(tmp_path_factory.mktemp("console")) as running:
        yield running


@pytest.fixture
def client(console):
    console.robot.lost = False
    with httpx.Client(
        base_url=console.url, headers={"Authorization": f"Bearer {TOKEN}"}, trust_env=False, timeout=10
    ) as opened:
        yield opened


def all_routes() -> list[Route]:
    return console_routes(FakeRobot(), runs=Path("runs"), ledger=None)


def write_run(folder: Path, name: str, report: str = "", **fields: Any) -> None:
    (folder / name).mkdir(parents=True)
    (folder / name / "episode.json").write_bytes(msgspec.json.encode(episode(name, **fields)))
    if report:
        (folder / name / "report.html").write_text(report)


@pytest.mark.parametrize("route", all_routes(), ids=lambda route: route.path)
def test_only_files_without_facts_about_the_robot_need_no_token(route: Route, console: ConsoleServer) -> None:
    method = next(iter(sorted((route.methods or set()) - {"HEAD"})))
    path = route.path.replace("{ticket}", "guessed")
    with httpx.Client(base_url=console.url, trust_env=False) as stranger:
        reply = stranger.request(method, path)
        foreign = stranger.request(method, path, headers={"Host": "evil.example"})
        page = stranger.request(method, path, headers={"Origin": "http://evil.example"})
    assert (foreign.status_code, page.status_code) == (421, 403)
    if is_public(path):
        assert reply.status_code == (404 if "guessed" in path else 200)
        assert "red_cube" not in reply.text
        assert TOKEN not in reply.text
        assert reply.headers.items() >= SECURITY.items()
        assert "default-src 'none'" in reply.headers["content-security-policy"]
    else:
        assert reply.status_code == 401
    assert console.robot.stops == []


def test_the_console_has_no_rights_beyond_those_of_its_protocol() -> None:
    rights = {name for name in vars(ConsoleRobot) if not name.startswith("_")}
    assert rights == {"name", "scene", "schema", "check", "events", "status", "stop"}
    changing = {route.path for route in all_routes() if (route.methods or set()) - {"GET", "HEAD"}}
    assert changing == {"/console/api/check", "/console/api/tickets", "/console/api/stop"}


CONTRACT = {
    "id": "c-0001",
    "context": {"robot": "panda", "registry": REGISTRY.hash},
    "action_sequence": [{"skill": "hold", "params": {"duration": 1.0}}],
}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(CONTRACT).encode(),
        json.dumps(CONTRACT | {"contract": {"id": "\u00e9"}}).encode(),
        b'{"id": "a", "id": "\\u0062"}',
        b"\xff\x00",
        b"",
        b'"\\ud800',
        b"1e999",
        b" " * (MAX_BYTES + 1),
    ],
    ids=["valid", "escape", "duplicate", "bytes", "empty", "surrogate", "number", "long"],
)
def test_the_gate_gets_the_bytes_of_the_editor_and_its_verdict_is_shown(text, console, client) -> None:
    reply = client.post("/console/api/check", content=text)
    assert console.robot.checked[-1] == text
    expected = msgspec.json.encode(verdict_view(FakeRobot().check(text)))
    assert reply.json()["accepted"] == json.loads(expected)["accepted"] == (text == json.dumps(CONTRACT).encode())
    assert reply.json().keys() == json.loads(expected).keys()


def test_hidden_characters_of_a_scene_are_visible(console, client) -> None:
    console.robot.summary, kept = f"{HIDDEN}: object\nplaces: none", console.robot.summary
    summary = client.get("/console/api/scene").json()["summary"]
    console.robot.summary = kept
    assert summary == "red\\u202ecube\\u200b: object\nplaces: none"


@pytest.mark.parametrize(
    ("body", "emergency"),
    [(b'{"emergency": true}', True), (b'{"emergency": false}', False), (b"", True), (b"[[[", True)],
    ids=["emergency", "stop", "empty", "malformed"],
)
def test_a_stop_is_an_emergency_stop_unless_the_body_states_otherwise(body, emergency, tmp_path) -> None:
    with serve_console(tmp_path) as console:
        reply = httpx.post(
            f"{console.url}/console/api/stop", content=body, headers={"Authorization": f"Bearer {TOKEN}"}
        )
    assert [one for one, _ in console.robot.stops] == [emergency]
    assert reply.json()["state"] == ("ESTOP" if emergency else "HOLD")


def test_a_lost_robot_becomes_a_sentence(console, client) -> None:
    console.robot.lost = True
    for reply in (client.get("/console/api/scene"), client.post("/console/api/check", content=b"{}")):
        assert (reply.status_code, reply.json()) == (503, {"error": "the gatekeeper closed the connection"})


def stream(client: httpx.Client, after: str, number: int) -> list[tuple[str, dict[str, Any]]]:
    """The first messages of the event stream."""
    found = []
    with client.stream("GET", f"/console/api/events?after={after}") as reply:
        assert reply.headers["content-type"].startswith("text/event-stream")
        rest = ""
        for text in reply.iter_text():
            *whole, rest = (rest + text).split("\n\n")
            lines = [part.split("\n") for part in whole]
            found += [(kind[len("event: ") :], json.loads(data[len("data: ") :])) for kind, data in lines]
            if len(found) >= number:
                return found
    return found


@pytest.mark.parametrize(
    ("after", "numbers"), [("0", [1, 2, 3]), ("2", [3]), ("999", [1, 2, 3]), ("x", [1, 2, 3])], ids=str
)
def test_the_stream_continues_after_an_event_and_restarts_on_another_server(after, numbers, tmp_path) -> None:
    with serve_console(tmp_path) as console:
        for k in range(3):
            console.robot.feed.add(0.5 * k, "phase", f"line\nevent: status {HIDDEN} {k}")
        with httpx.Client(base_url=console.url, headers={"Authorization": f"Bearer {TOKEN}"}) as client:
            found = stream(client, after, len(numbers) + 1)
    events, states = ([data for kind, data in found if kind == one] for one in ("event", "status"))
    assert [one["number"] for one in events] == numbers
    assert "\u202e" not in events[0]["text"]
    assert states[0] == {"state": "NONE", "reason": "", "busy": False, "reporting": True}


def test_the_first_events_of_another_server_follow_those_of_an_earlier_one(tmp_path) -> None:
    """A page that was open before connects before the new server has an event."""
    with serve_console(tmp_path) as console:
        threading.Timer(0.3, lambda: console.robot.feed.add(0.5, "phase", "the first")).start()
        with httpx.Client(base_url=console.url, headers={"Authorization": f"Bearer {TOKEN}"}) as client:
            found = stream(client, "999", 3)
    assert [data["text"] for kind, data in found if kind == "event"] == ["the first"]


def test_a_server_with_more_events_than_the_earlier_one_sends_all_of_them(tmp_path) -> None:
    """A page that was open before a restart has the number of an event of the earlier server."""
    with serve_console(tmp_path) as console:
        for k in range(3):
            console.robot.feed.add(0.5 * k, "phase", f"event {k}")
        with httpx.Client(base_url=console.url, headers={"Authorization": f"Bearer {TOKEN}"}) as client:
            first = stream(client, "0&server=", 5)
            own = first[0][1]["id"]
            same, other = stream(client, f"2&server={own}", 3), stream(client, "2&server=another", 5)
    assert [kind for kind, _ in first] == ["server", "event", "event", "event", "status"]
    assert [data["number"] for kind, data in same if kind == "event"] == [3]
    assert [data["number"] for kind, data in other if kind == "event"] == [1, 2, 3]
    assert other[0] == ("server", {"id": own})


def test_a_stream_ends_with_the_server(tmp_path) -> None:
    with serve_console(tmp_path) as console:
        console.ended.set()
        with httpx.Client(base_url=console.url, headers={"Authorization": f"Bearer {TOKEN}"}) as client:
            assert client.get("/console/api/events").text == ""


# --- runs and reports -------------------------------------------------------------------------------------------------


def test_runs_are_listed_with_their_citations_and_other_entries_are_counted(tmp_path) -> None:
    recall = RetrievedContext(
        passages=(
            Passage(
                citation="rules@1:0-9",
                kind="rules",
                trust="site",
                title="Rules",
                text="x",
                likeness=0.5,
                score=0.5,
                rank=1,
            ),
        )
    )
    write_run(tmp_path, "first", report="<p>", recall=recall)
    write_run(tmp_path, "second", kind="failed")
    for k, name in enumerate(("first", "second")):
        os.utime(tmp_path / name, (k, k))
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "episode.json").write_text('{"instruction": 3}')
    (tmp_path / "link").symlink_to(tmp_path / "first")
    found = list_runs(tmp_path)
    runs = {one["name"]: one for one in found["runs"]}
    assert list(runs) == ["second", "first"]
    assert found["omitted"] == 1
    assert (runs["first"]["report"], runs["first"]["cites"]) == (True, ["rules@1:0-9"])
    assert (runs["second"]["outcome"], runs["second"]["reason"], runs["second"]["report"]) == (
        "failed",
        "it failed",
        False,
    )
    assert list_runs(tmp_path / "none") == {"runs": [], "omitted": 0}


def test_a_run_that_is_deleted_while_the_runs_are_listed_hides_no_other(tmp_path, monkeypatch) -> None:
    for name in ("first", "second", "third"):
        write_run(tmp_path, name)

    def delete_second(entry):
        if entry.name == "second":
            shutil.rmtree(entry.path)
        return True

    monkeypatch.setattr(run_list, "_is_folder", delete_second)
    found = list_runs(tmp_path)
    assert {one["name"] for one in found["runs"]} == {"first", "third"}
    assert found["omitted"] == 0


@pytest.mark.parametrize("kind", ["succeeded", "failed", "rejected", "aborted", "stopped"])
def test_the_console_lists_and_opens_the_report_of_an_agent(kind, tmp_path) -> None:
    saved, run = SavedRuns(tmp_path, load_robot("panda")), episode("r-1", kind=kind)
    saved.save_episode(run)
    assert saved.save_report(run, [Event(0.5, "verdict", "the contract was checked")]) == ""
    assert [(one["name"], one["report"]) for one in list_runs(tmp_path)["runs"]] == [("r-1", True)]
    report = read_report(tmp_path, "r-1")
    assert isinstance(report, bytes)
    assert all(part in report for part in (b"put the red cube in the bowl", b"the contract was checked"))


@pytest.mark.parametrize("name", ["", ".", "..", "../secret", "link", "a/b", "none\0", "file", "linked_report"])
def test_only_reports_of_runs_in_the_folder_can_be_named(name, tmp_path) -> None:
    runs = tmp_path / "runs"
    write_run(runs, "good", report="<p>good</p>")
    write_run(tmp_path, "secret", report="<p>secret</p>")
    (tmp_path / "report.html").write_text("<p>secret</p>")
    (runs / "link").symlink_to(tmp_path / "secret")
    write_run(runs, "linked_report")
    (runs / "linked_report" / "report.html").symlink_to(tmp_path / "report.html")
    (runs / "file").write_text("<p>secret</p>")
    assert isinstance(read_report(runs, name), FileRefusal)
    assert read_report(runs, "good") == b"<p>good</p>"


def test_a_report_is_sent_once_for_a_ticket_and_in_a_sandbox(console, client) -> None:
    write_run(console.runs, "r-1", report="<script>1</script>")
    path = client.post("/console/api/tickets", json={"run": "r-1"}).json()["path"]
    with httpx.Client(base_url=console.url, trust_env=False) as frame:
        first, second = frame.get(path), frame.get(path)
    assert (first.status_code, first.text, second.status_code) == (200, "<script>1</script>", 404)
    policy = first.headers["content-security-policy"].split("; ")
    assert {"sandbox", "default-src 'none'", "frame-ancestors 'self'"} <= set(policy)
    assert not any("script" in one for one in policy)
    assert TOKEN not in path


def test_a_ticket_expires_and_their_number_is_bounded() -> None:
    now = [0.0]
    tickets = ReportTickets(lambda: now[0])
    late, first = tickets.issue("a"), tickets.issue("b")
    now[0] = LIFETIME
    assert tickets.redeem(late) == ""
    many = [tickets.issue(str(k)) for k in range(MAX_TICKETS)]
    assert tickets.redeem(first) == ""
    assert [tickets.redeem(one) for one in many] == [str(k) for k in range(MAX_TICKETS)]


# --- memory -----------------------------------------------------------------------------------------------------------


def test_memories_are_listed_with_weights_and_citations_in_both_directions(console, client) -> None:
    assert "first run creates it" in client.get("/console/api/memory").json()["reason"]
    with open_ledger(console.ledger.parent, console.ledger.name) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("e-1"), REST_POSTURE, now=NOW)
        recall = memory.retrieve("put the red cube in the bowl", "", REST_POSTURE, "arm", "aaaa1111", k=1)
        memory.store(episode("e-2", instruction=HIDDEN, recall=recall), REST_POSTURE, now=NOW)
        weights = memory.weights()
    found = client.get("/console/api/memory").json()
    second, first = found["memories"]
    assert (second["id"], second["cites"], second["cited"]) == ("e-2", ["e-1"], 0)
    assert (first["id"], first["cites"], first["cited"]) == ("e-1", [], 1)
    assert {one["id"]: one["weight"] for one in found["memories"]} == weights
    assert second["instruction"] == "red\\u202ecube\\u200b"
    console.ledger.write_bytes(b"not a ledger")
    damaged = client.get("/console/api/memory")
    assert (damaged.status_code, damaged.json()["memories"]) == (200, [])
    assert damaged.json()["reason"]


# --- files ------------------------------------------------------------------------------------------------------------


def test_the_files_need_no_other_server_and_make_no_markup_from_text() -> None:
    scripts = {path.name: path.read_text() for path in STATIC.glob("*.js")}
    page = (STATIC / "page.html").read_text()
    for text in (*scripts.values(), page, (STATIC / "console.css").read_text()):
        for word in (
            "http:",
            "https:",
            "innerHTML",
            "outerHTML",
            "insertAdjacent",
            "document.write",
            "eval(",
            "@import",
        ):
            assert word not in text
    assert " on" not in page.replace(" once", "").replace(" only", "")
    assert "<style" not in page
    assert page.count("<script") == page.count('<script type="module" src="/console/static/')
    assert sum(text.count("\n") for text in scripts.values()) < 450


def test_a_stop_waits_for_no_other_request(tmp_path) -> None:
    """45 requests, more than the threads of the server, wait for the robot; the stop overtakes all of them."""
    release, begun = threading.Event(), threading.Semaphore(0)

    def blocked() -> dict[str, Any]:
        begun.release()
        release.wait(30.0)
        return {}

    with serve_console(tmp_path) as console, ExitStack() as stack:
        stack.callback(release.set)
        console.robot.scene = blocked
        port = int(console.url.rpartition(":")[2])
        request = f"GET /console/api/scene HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
        for _ in range(45):
            stack.enter_context(socket.create_connection(("127.0.0.1", port))).sendall(request.encode())
        for _ in range(40):
            assert begun.acquire(timeout=10.0)
        reply = httpx.post(f"{console.url}/console/api/stop", headers={"Authorization": f"Bearer {TOKEN}"})
        assert (reply.status_code, len(console.robot.stops)) == (200, 1)
