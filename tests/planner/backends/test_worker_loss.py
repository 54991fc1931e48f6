"""A lost worker is discarded after any kind of request, so that the next request starts a new one."""

import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.serving.adapted_planner import AdaptedPlanner, AdapterMismatchError
from dualbrain.planner import protocol
from dualbrain.planner.backends import llama_cpp, llama_process
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.backends.stderr_tail import MAX_REPORTED_CHARACTERS, describe_exit
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, UNCONSTRAINED_SHORT_PROMPT, without_constraints
from dualbrain.planner.prompt.short_prompt import short_template_hash
from tests.planner.backends.fake_chat_server import chat_completion
from tests.planner.sample_requests import REGISTRY, plan_request

LOUD = 300_000
"""Number of characters on standard error, more than the buffer of a pipe."""
WORKER = f"""
import json, os, socket, sys, threading, time
settings = json.loads(sys.stdin.readline())
behaviour = open(settings["model"]).read()
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
if behaviour == "exits":
    sys.exit()
if behaviour.startswith("writes"):
    key = "Bearer " + settings["key"]
    sys.stderr.write("the beginning\\n" + {LOUD} * "x" + "\\n" + key + "\\n\\x1b[31mno memory \\u00e9\\n\\n")
    sys.stderr.flush()
if behaviour == "writes and aborts":
    os.kill(os.getpid(), 6)
if behaviour == "exits during the reply":
    print('{{"addr', end="", flush=True)
    sys.exit()
if behaviour == "fails to start":
    print(json.dumps({{"error": "no model"}}), flush=True)
if behaviour in {{"hangs", "fails to start"}}:
    time.sleep(60)
with socket.create_server(("127.0.0.1", 0)) as server:
    print(json.dumps({{"address": "http://127.0.0.1:%d" % server.getsockname()[1]}}), flush=True)
    while behaviour != "hangs in a request":
        call = server.accept()[0]
        request, size = call.makefile("rb"), 0
        for line in iter(request.readline, b"\\r\\n"):
            size = int(line[15:]) if line.lower().startswith(b"content-length:") else size
        request.read(size)  # completely, because closing before would break the connection
        request.close()
        if behaviour == "exits in a request":
            sys.exit()
        call.sendall(b"HTTP/1.0 200 OK\\r\\n\\r\\n" + {chat_completion("words")!r})
        call.close()
    time.sleep(60)
"""
"""A replacement of the worker process; the content of the model file determines its behaviour."""
LOST = {
    "exits": protocol.CRASHED,
    "exits during the reply": protocol.CRASHED,
    "hangs": protocol.TIMEOUT,
    "fails to start": protocol.ERROR,
    "exits in a request": protocol.CRASHED,
    "hangs in a request": protocol.TIMEOUT,
}


CARD = AdapterCard(
    id="a" * 64,
    base="tiny",
    base_sha256="b" * 64,
    robot=REGISTRY.robot,
    registry=REGISTRY.hash,
    prompt=short_template_hash(),
    dataset="d" * 64,
    sources={},
    bootstrapped=False,
    precision="float32",
    steps=7,
    held_out=None,
    config=AdaptConfig(),
    versions={},
)


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model file for this worker."""
    (tmp_path / "worker.py").write_text(WORKER)
    (tmp_path / "m.gguf").write_text("answers")
    monkeypatch.setattr(llama_process, "_WORKER_SCRIPT", tmp_path / "worker.py")
    monkeypatch.setattr(llama_cpp, "find_spec", lambda name: sys)
    return tmp_path / "m.gguf"


@pytest.fixture
def planner(model: Path) -> Iterator[LlamaPlanner]:
    planner = LlamaPlanner("m", model, LlamaConfig(timeout_s=2.0), prompt_format=UNCONSTRAINED_SHORT_PROMPT)
    yield planner
    planner.close()


def failure(planner: LlamaPlanner) -> str:
    """The finish reason of a failed request to the worker, "" after a success."""
    response = planner.post_json("/v1/chat/completions", {})
    return response.finish_reason if isinstance(response, ChatResponse) else ""


@pytest.mark.parametrize("behaviour", LOST)
def test_a_worker_that_is_lost_in_any_request_is_discarded(planner: LlamaPlanner, model: Path, behaviour: str) -> None:
    planner.close()
    model.write_text(behaviour)
    assert failure(planner) == LOST[behaviour]
    assert planner.pid is None
    model.write_text("answers")
    assert failure(planner) == ""
    first = planner.pid
    assert failure(planner) == ""
    assert planner.pid == first is not None  # a worker that answers is kept


def test_a_model_file_that_is_deleted_during_a_run_leaves_a_finish_reason(model: Path, tmp_path: Path) -> None:
    config = LlamaConfig(timeout_s=2.0, prompt_cache=tmp_path, jump_forward=False)
    planner = LlamaPlanner("m", model, config, prompt_format=without_constraints(FULL_PROMPT))
    try:
        assert planner.propose(plan_request()).finish_reason == protocol.STOP
        model.unlink()
        assert planner.propose(plan_request()).finish_reason == protocol.STOP
    finally:
        planner.close()


def test_a_dead_worker_is_reported_with_its_exit_and_its_standard_error(planner: LlamaPlanner, model: Path) -> None:
    planner.close()
    model.write_text("writes and aborts")
    response = planner.post_json("/v1/chat/completions", {})
    assert isinstance(response, ChatResponse)
    assert response.finish_reason == protocol.CRASHED
    assert response.detail.startswith("signal 6 (Aborted): x")
    assert response.detail.endswith("x | Bearer [key] | \\x1b[31mno memory \\xe9")
    assert len(response.detail) <= len("signal 6 (Aborted): ") + MAX_REPORTED_CHARACTERS
    model.write_text("exits in a request")
    assert planner.propose(plan_request()).finish_reason == f"{protocol.CRASHED}: exit code 0"


def test_a_worker_with_much_output_is_not_blocked(planner: LlamaPlanner, model: Path) -> None:
    planner.close()
    model.write_text("writes much and answers")
    assert failure(planner) == ""


def test_a_kill_is_reported_as_a_possible_lack_of_memory() -> None:
    assert "ran out of memory" in describe_exit(-signal.SIGKILL)
    assert describe_exit(-signal.SIGSEGV) == "signal 11 (Segmentation fault)"
    assert describe_exit(3) == "exit code 3"


@pytest.mark.parametrize("faulty", [lambda planner: "another", lambda planner: 1 / 0], ids=["fault", "raises"])
def test_no_worker_is_left_after_a_failed_check_of_an_adapter(
    planner: LlamaPlanner, faulty: Callable[[LlamaPlanner], str]
) -> None:
    with pytest.raises((AdapterMismatchError, ZeroDivisionError)):
        AdaptedPlanner(planner, CARD, faulty)
    assert planner.pid is None


def test_an_adapter_whose_canary_was_lost_proposes_again_with_the_next_worker(
    planner: LlamaPlanner, model: Path
) -> None:
    adapted = AdaptedPlanner(planner, CARD, failure)
    planner.close()
    model.write_text("exits in a request")
    reason = adapted.propose(plan_request()).finish_reason
    assert reason == f"error: the adapter does not answer as recorded: {protocol.CRASHED}"
    model.write_text("answers")
    assert adapted.propose(plan_request()).finish_reason == protocol.STOP
