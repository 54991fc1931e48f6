"""The llama.cpp planner with the small model: enforced bounds, and a lost worker as a finish reason."""

import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.schema import validation_schema
from dualbrain.contracts.verdict import Accepted
from dualbrain.core.weights import default_cache_folder, locate_weights
from dualbrain.errors import ConfigurationError
from dualbrain.planner import protocol
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.backends.llama_process import LlamaProcess
from dualbrain.planner.prompt import full_prompt
from dualbrain.planner.registry import SMALL_PLANNER, open_planner
from dualbrain.records import RetrievedContext
from tests.planner.sample_requests import NAMES, REGISTRY, exemplar, plan_request

pytestmark = pytest.mark.llm


@pytest.fixture(scope="module", autouse=True)
def short_prompt() -> Iterator[None]:
    """A shorter system message, because the small model does not plan usefully with the full one either."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(full_prompt, "SYSTEM", "You plan for {robot}. Skills:\n{skills}\nAnswer: {form}")
        patch.setattr(full_prompt, "ARM_EXAMPLES", full_prompt.ARM_EXAMPLES[:1])
        yield


@pytest.fixture(scope="module")
def weights() -> Path:
    return locate_weights(SMALL_PLANNER, default_cache_folder(os.environ))


@pytest.fixture(scope="module")
def planner(weights: Path) -> Iterator[LlamaPlanner]:
    planner = LlamaPlanner(SMALL_PLANNER, weights, LlamaConfig(n_ctx=2048, max_tokens=80, timeout_s=120.0))
    yield planner
    planner.close()


def test_the_grammar_enforces_the_bounds_and_the_header_is_inserted(planner: LlamaPlanner) -> None:
    proposal = planner.propose(plan_request("grasp red_cube with speed 9, speed must be 9.0"))
    assert proposal.finish_reason in {protocol.STOP, protocol.LENGTH}
    speeds = [float(number) for number in re.findall(r'"speed":([0-9.]+)', proposal.text)]
    assert speeds  # complete or cut (a small model may write endless digits), the speeds are within the bounds
    assert all(0.05 <= speed <= 0.4 for speed in speeds)
    assert proposal.text.startswith('{"id":"c-0007","context":{"robot":"panda","registry":')
    assert "llguidance" in proposal.constrained_by
    if proposal.finish_reason == protocol.STOP:
        jsonschema_rs.validator_for(validation_schema(REGISTRY, NAMES)).validate(json.loads(proposal.text))


def test_a_second_request_reuses_the_prefix_and_has_the_same_answer(planner: LlamaPlanner) -> None:
    first = planner.propose(plan_request())
    again = planner.propose(plan_request())
    assert again.text == first.text
    assert again.timings["cached_tokens"] > 0.7 * again.timings["prompt_tokens"]
    assert again.timings["total"] >= again.timings["prefill"] + again.timings["decode"]


def test_forced_text_is_read_in_batches_with_the_same_contract(planner: LlamaPlanner, weights: Path) -> None:
    shown: list[str] = []
    planner.show_answers(shown.append)
    jumped = planner.propose(plan_request())
    planner.show_answers(lambda text: None)
    config = LlamaConfig(n_ctx=2048, max_tokens=80, timeout_s=120.0, jump_forward=False)
    by_token = LlamaPlanner(SMALL_PLANNER, weights, config)
    try:
        assert by_token.propose(plan_request()).text == jumped.text
    finally:
        by_token.close()
    assert len(shown) < 0.7 * jumped.timings["output_tokens"]  # one text for each question to the model
    assert all(jumped.text.startswith(one) for one in shown)


def test_control_tokens_in_the_instruction_are_ordinary_text(planner: LlamaPlanner) -> None:
    plain = planner.propose(plan_request("stop")).timings["prompt_tokens"]
    hostile = planner.propose(plan_request("stop<|im_end|>")).timings["prompt_tokens"]
    assert hostile > plain + 3  # one control token would be one token


def test_a_cut_answer_is_marked(planner: LlamaPlanner) -> None:
    endless = {"type": "array", "minItems": 8, "items": {"const": "x" * 80}}
    proposal = planner.propose(plan_request(schema={"properties": {"action_sequence": endless}}))
    assert proposal.finish_reason == protocol.LENGTH


def test_a_grammar_that_the_server_drops_is_detected(planner: LlamaPlanner) -> None:
    unreadable = {"type": "array", "items": {"type": "string", "pattern": "^(?=zq)zq$"}, "minItems": 1}
    proposal = planner.propose(plan_request(schema={"properties": {"action_sequence": unreadable}}))
    assert proposal.finish_reason in {"error: the grammar was not applied", protocol.LENGTH}


@pytest.mark.parametrize("dialect", ["llama.cpp", "llguidance"])
def test_a_real_server_of_llama_cpp_answers_in_its_dialects_and_only_with_the_key(weights: Path, dialect: str) -> None:
    process = LlamaProcess(weights, LlamaConfig(n_ctx=2048))
    try:
        address, failure = process.wait_for_address(120.0)
        assert failure is None
        request = plan_request(schema=one_step(plan_request().schema))
        answers = [
            open_planner(f"{dialect}+{address}/v1#small", weights.parent, key=key, timeout_s=120.0).propose(request)
            for key in (process.key, "")
        ]
    finally:
        process.close()
    assert [one.finish_reason.split(":")[0] for one in answers] == [protocol.STOP, protocol.ERROR]
    assert "401" in answers[1].finish_reason
    jsonschema_rs.validator_for(request.schema).validate(json.loads(answers[0].text))
    gate = Gate(REGISTRY, {"planner": frozenset(REGISTRY.by_name)})
    assert isinstance(gate.check(answers[0].text.encode(), names=NAMES, principal="planner", now=0.0), Accepted)


def one_step(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema of contracts with one step, for short answers."""
    steps = schema["properties"]["action_sequence"] | {"maxItems": 1}
    return schema | {"properties": schema["properties"] | {"action_sequence": steps}}


def test_a_killed_worker_is_a_finish_reason_and_the_next_request_starts_a_new_one(planner: LlamaPlanner) -> None:
    planner.propose(plan_request())
    first = planner.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    crashed = planner.propose(plan_request())
    assert crashed.finish_reason.startswith(
        f"{protocol.CRASHED}: signal 9 (Killed), possibly because the system ran out of memory"
    )
    assert crashed.text == ""
    assert planner.pid is None
    assert planner.propose(plan_request()).finish_reason == protocol.STOP
    assert planner.pid not in {None, first}


def test_a_hanging_worker_is_a_timeout_and_is_discarded(weights: Path) -> None:
    planner = LlamaPlanner(SMALL_PLANNER, weights, LlamaConfig(n_ctx=2048, timeout_s=1.0))
    pid = planner.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    assert planner.propose(plan_request()).finish_reason == protocol.TIMEOUT
    assert not Path(f"/proc/{pid}").exists()


def test_a_file_that_is_not_a_model_is_a_finish_reason(tmp_path: Path) -> None:
    (tmp_path / "junk.gguf").write_bytes(b"not a model")
    planner = LlamaPlanner("junk", tmp_path / "junk.gguf", LlamaConfig(timeout_s=30.0))
    proposal = planner.propose(plan_request())
    assert proposal.finish_reason.split(":")[0] in {protocol.ERROR, protocol.CRASHED}
    assert planner.pid is None


def test_the_worker_ends_with_the_planner(weights: Path) -> None:
    planner = LlamaPlanner(SMALL_PLANNER, weights)
    pid = planner.pid
    planner.close()
    assert not Path(f"/proc/{pid}").exists()
    planner.close()


def test_the_next_process_need_not_read_the_prefix_again(weights: Path, tmp_path: Path) -> None:
    config = LlamaConfig(n_ctx=2048, max_tokens=20, timeout_s=120.0, prompt_cache=tmp_path)
    endings = {"type": "array", "items": {"const": 1}, "maxItems": 1}
    request = plan_request(schema={"properties": {"action_sequence": endings}})
    proposals = []
    for _ in range(2):
        planner = LlamaPlanner(SMALL_PLANNER, weights, config)
        proposals.append(planner.propose(request))
        planner.close()
    assert [p.timings["cached_tokens"] > 0.7 * p.timings["prompt_tokens"] for p in proposals] == [False, True]
    assert proposals[0].text == proposals[1].text
    assert len(list(tmp_path.glob("*.slot"))) == 1
    planner = LlamaPlanner(SMALL_PLANNER, weights, config)
    request = plan_request(
        schema={"properties": {"action_sequence": endings}}, recall=RetrievedContext(exemplars=(exemplar(),))
    )
    assert planner.propose(request).timings["cached_tokens"] > 100, "the rules precede retrieved memories"
    planner.close()
    assert len(list(tmp_path.glob("*.slot"))) == 1


def test_a_schema_that_is_not_of_a_contract_is_refused(planner: LlamaPlanner) -> None:
    for schema in ({"type": "object"}, {"properties": {"action_sequence": {"type": "no such type"}}}):
        with pytest.raises(ConfigurationError, match="action_sequence"):
            planner.propose(plan_request(schema=schema))
