"""A run as a trace: the spans are those of the episode in their order, and arrive at a collector as they are."""

import gzip
import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import pairwise

import msgspec
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from dualbrain.cli.main import run_command_line
from dualbrain.contracts.verdict import Accepted
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.records import ActionResult, Attempt, Proposal
from dualbrain.runtime.inspection.run_trace import episode_spans, read_episode_file
from tests.memory.memory_samples import episode as sample_episode
from tests.memory.memory_samples import grasp_contract

START_NS = 1_800_000_000_000_000_000
"""2027-01-15 08:00 UTC [ns since 1970]."""


@pytest.fixture
def episode():
    found = sample_episode("e-1", refused=3.0)
    timings = {"total": 2.0, "prompt_tokens": 460.0, "output_tokens": 104.0}
    answer = Proposal(text="{}", finish_reason="stop", planner="base-135m", timings=timings)
    accepted = Attempt(answer, Accepted(grasp_contract()), 0.25)
    actions = tuple(
        ActionResult(skill=skill, status="done", reason="", started=begin, ended=end, Delta=0.5)
        for skill, begin, end in (("grasp", 2.0, 5.0), ("place", 5.0, 9.0))
    )
    return msgspec.structs.replace(
        found,
        attempts=(*found.attempts, accepted),
        timings={"retrieval": 0.5},
        outcome=msgspec.structs.replace(found.outcome, actions=actions),
    )


@pytest.fixture
def run_folder(episode, tmp_path):
    (tmp_path / "episode.json").write_bytes(msgspec.json.encode(episode))
    return tmp_path


def test_spans_follow_each_other_inside_the_root(episode):
    *parts, root = episode_spans(episode)
    assert root.name == "episode"
    assert [span.name for span in parts] == [
        "retrieve",
        "chat scripted",
        "gate",
        "chat base-135m",
        "gate",
        "action grasp",
        "action place",
    ]
    ends = [500e6, 600e6, 600.1e6, 2600.1e6, 2850.1e6, 5850.1e6, 9850.1e6]
    assert [span.end_time - START_NS for span in parts] == pytest.approx(ends, abs=1e3)
    assert (root.start_time, root.end_time) == (parts[0].start_time, parts[-1].end_time)
    for before, after in pairwise(parts):
        assert before.end_time == after.start_time
    assert {span.parent.span_id for span in parts} == {root.context.span_id}
    assert len({span.context.span_id for span in (*parts, root)}) == 8


def test_attributes_name_the_model_the_verdict_and_the_outcome(episode):
    spans = {(span.name, number): dict(span.attributes) for number, span in enumerate(episode_spans(episode))}
    asked = spans["chat base-135m", 3]
    assert asked["gen_ai.request.model"] == "base-135m"
    assert (asked["gen_ai.usage.input_tokens"], asked["gen_ai.usage.output_tokens"]) == (460, 104)
    assert spans["gate", 2] == {
        "dualbrain.verdict": "rejected",
        "dualbrain.stage": "envelope",
        "dualbrain.pointer": "/action_sequence/0/params/speed",
    }
    assert spans["gate", 4] == {"dualbrain.verdict": "accepted"}
    root = spans["episode", 7]
    assert (root["dualbrain.episode"], root["dualbrain.outcome"]) == ("e-1", episode.outcome.kind)
    assert "dualbrain.h_min" not in root, "no value, no attribute"


def test_a_second_export_is_the_same_trace(episode):
    first, second = ([span.to_json() for span in episode_spans(episode)] for _ in range(2))
    assert first == second
    other = msgspec.structs.replace(episode, started="2027-01-15T08:00:01Z")
    assert episode_spans(other)[0].context.trace_id != episode_spans(episode)[0].context.trace_id


def test_a_rejected_episode_without_actions_is_a_trace(episode):
    rejected = msgspec.structs.replace(
        episode, attempts=episode.attempts[:1], outcome=msgspec.structs.replace(episode.outcome, actions=())
    )
    assert [span.name for span in episode_spans(rejected)] == ["retrieve", "chat scripted", "gate", "episode"]


@pytest.mark.parametrize("data", [b"", b"{}", b"\xff", b"[" * 5000, b'{"id": 1}'])
def test_a_damaged_episode_is_an_error_that_names_the_file(tmp_path, data):
    with pytest.raises(MissingDependencyError, match="finished run"):
        read_episode_file(tmp_path)
    (tmp_path / "episode.json").write_bytes(data)
    with pytest.raises(ConfigurationError, match=r"damaged.*episode\.json"):
        read_episode_file(tmp_path)


def test_the_command_prints_or_sends_the_spans(run_folder, episode, capsys):
    received = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self):
            data = self.rfile.read(int(self.headers["content-length"]))
            received.append(gzip.decompress(data) if self.headers.get("content-encoding") == "gzip" else data)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    assert run_command_line(["export", "trace", str(run_folder)]) == 0
    names = [json.loads(line)["name"] for line in capsys.readouterr().out.splitlines()]
    server = HTTPServer(("127.0.0.1", 0), Collector)
    thread = threading.Thread(target=server.handle_request)
    thread.start()
    endpoint = f"http://127.0.0.1:{server.server_port}/v1/traces"
    assert run_command_line(["export", "trace", str(run_folder), "--endpoint", endpoint]) == 0
    thread.join()
    server.server_close()
    request = ExportTraceServiceRequest.FromString(received[0])
    (scope,) = request.resource_spans[0].scope_spans
    assert [span.name for span in scope.spans] == names == [span.name for span in episode_spans(episode)]


def test_a_collector_that_does_not_answer_is_an_error(run_folder, capsys, monkeypatch):
    monkeypatch.setattr("dualbrain.cli.evaluation.export_trace.TIMEOUT_S", 0.2)
    assert run_command_line(["export", "trace", str(run_folder), "--endpoint", "http://127.0.0.1:9/v1/traces"]) == 5
    assert "was not accepted at http://127.0.0.1:9/v1/traces" in capsys.readouterr().err
    assert run_command_line(["export", "trace", str(run_folder), "--endpoint", "ftp://x"]) == 2


def test_the_refusal_of_an_endpoint_shows_no_password(run_folder, capsys):
    assert run_command_line(["export", "trace", str(run_folder), "--endpoint", "ftp://user:pa55word@x/v1?key=a"]) == 2
    assert "'ftp://x/v1'" in (shown := capsys.readouterr().err)
    assert "pa55word" not in shown
