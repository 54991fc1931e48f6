"""A child that is lost is put away whoever asked it, so that the next question is asked of a new one."""

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
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT
from dualbrain.planner.prompt.short_prompt import short_template_hash
from tests.planner.backends.fake_chat_server import chat_completion
from tests.planner.sample_requests import REGISTRY, plan_request

LOUD = 300_000
"""Characters on standard error: more than a pipe holds."""
CHILD = f"""
import json, os, socket, sys, threading, time
told = json.loads(sys.stdin.readline())
how = open(told["model"]).read()
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
if how == "dies":
    sys.exit()
if how.startswith("says"):
    key = "Bearer " + told["key"]
    sys.stderr.write("the beginning\\n" + {LOUD} * "x" + "\\n" + key + "\\n\\x1b[31mno memory \\u00e9\\n\\n")
    sys.stderr.flush()
if how == "says and dies":
    os.kill(os.getpid(), 6)
if how == "dies while it tells":
    print('{{"addr', end="", flush=True)
    sys.exit()
if how == "cannot":
    print(json.dumps({{"error": "no model"}}), flush=True)
if how in {{"hangs", "cannot"}}:
    time.sleep(60)
with socket.create_server(("127.0.0.1", 0)) as server:
    print(json.dumps({{"address": "http://127.0.0.1:%d" % server.getsockname()[1]}}), flush=True)
    while how != "hangs when asked":
        call = server.accept()[0]
        asked, size = call.makefile("rb"), 0
        for line in iter(asked.readline, b"\\r\\n"):
            size = int(line[15:]) if line.lower().startswith(b"content-length:") else size
        asked.read(size)  # whole: who closes on a question that still comes breaks the connection
        asked.close()
        if how == "dies when asked":
            sys.exit()
        call.sendall(b"HTTP/1.0 200 OK\\r\\n\\r\\n" + {chat_completion("words")!r})
        call.close()
    time.sleep(60)
"""
"""In place of the process with the model; what stands in the model's file says how it behaves."""
LOST = {
    "dies": protocol.CRASHED,
    "dies while it tells": protocol.CRASHED,
    "hangs": protocol.TIMEOUT,
    "cannot": protocol.ERROR,
    "dies when asked": protocol.CRASHED,
    "hangs when asked": protocol.TIMEOUT,
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
    """A model's file for such children."""
    (tmp_path / "child.py").write_text(CHILD)
    (tmp_path / "m.gguf").write_text("answers")
    monkeypatch.setattr(llama_process, "_WORKER_SCRIPT", tmp_path / "child.py")
    monkeypatch.setattr(llama_cpp, "find_spec", lambda name: sys)
    return tmp_path / "m.gguf"


@pytest.fixture
def planner(model: Path) -> Iterator[LlamaPlanner]:
    planner = LlamaPlanner("m", model, LlamaConfig(timeout_s=2.0), prompt_format=UNCONSTRAINED_SHORT_PROMPT)
    yield planner
    planner.close()


def told(planner: LlamaPlanner) -> str:
    """Why the planner's child has no answer, "" if it has."""
    answer = planner.post_json("/v1/chat/completions", {})
    return answer.finish_reason if isinstance(answer, ChatResponse) else ""


@pytest.mark.parametrize("how", LOST)
def test_one_that_is_lost_over_a_question_of_any_kind_is_put_away(planner: LlamaPlanner, model: Path, how: str) -> None:
    planner.close()
    model.write_text(how)
    assert told(planner) == LOST[how]
    assert planner.pid is None
    model.write_text("answers")
    assert told(planner) == ""
    first = planner.pid
    assert told(planner) == ""
    assert planner.pid == first is not None  # one that answers is kept


def test_one_that_died_is_told_with_its_end_and_its_last_words(planner: LlamaPlanner, model: Path) -> None:
    planner.close()
    model.write_text("says and dies")
    answer = planner.post_json("/v1/chat/completions", {})
    assert isinstance(answer, ChatResponse)
    assert answer.finish_reason == protocol.CRASHED
    assert answer.detail.startswith("signal 6 (Aborted): x")
    assert answer.detail.endswith("x | Bearer [key] | \\x1b[31mno memory \\xe9")
    assert len(answer.detail) <= len("signal 6 (Aborted): ") + MAX_REPORTED_CHARACTERS
    model.write_text("dies when asked")
    assert planner.propose(plan_request()).finish_reason == f"{protocol.CRASHED}: exit code 0"


def test_one_that_says_much_does_not_wait_for_anybody_to_read_it(planner: LlamaPlanner, model: Path) -> None:
    planner.close()
    model.write_text("says much and answers")
    assert told(planner) == ""


def test_a_signal_that_a_system_short_of_memory_sends_is_told_as_one() -> None:
    assert "short of memory" in describe_exit(-signal.SIGKILL)
    assert describe_exit(-signal.SIGSEGV) == "signal 11 (Segmentation fault)"
    assert describe_exit(3) == "exit code 3"


@pytest.mark.parametrize("faulty", [lambda planner: "another", lambda planner: 1 / 0], ids=["fault", "raises"])
def test_no_child_is_left_of_an_adapter_that_is_not_itself(
    planner: LlamaPlanner, faulty: Callable[[LlamaPlanner], str]
) -> None:
    with pytest.raises((AdapterMismatchError, ZeroDivisionError)):
        AdaptedPlanner(planner, CARD, faulty)
    assert planner.pid is None


def test_an_adapter_whose_canary_was_lost_proposes_again_with_the_next_child(
    planner: LlamaPlanner, model: Path
) -> None:
    adapted = AdaptedPlanner(planner, CARD, told)
    planner.close()
    model.write_text("dies when asked")
    reason = adapted.propose(plan_request()).finish_reason
    assert reason == f"error: the adapter does not answer as recorded: {protocol.CRASHED}"
    model.write_text("answers")
    assert adapted.propose(plan_request()).finish_reason == protocol.STOP
