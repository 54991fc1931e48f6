"""The local full prompt is the full prompt without id and context, and a completed answer is the same contract."""

import hashlib
import json
import re
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.prompt import full_prompt
from dualbrain.planner.prompt.arm_examples import DECLINE_EXAMPLE
from dualbrain.planner.prompt.full_prompt import ChatMessage, local_template_hash, render, render_local, template_hash
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, LOCAL_FULL_PROMPT, SHORT_PROMPT, without_constraints
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.request import PlanRequest
from dualbrain.records import RetrievedContext
from tests.planner.sample_requests import exemplar, plan_request

HEADER = re.compile(r'"id":"c-\d{4}","context":\{"robot":"[^"]*","registry":"[^"]*"\},')
QUESTION_END = re.compile(r"\nContract c-\d{4}:\Z")
DRIVES = "drive_to(place: receptive name)"
REJECTED = Rejected(stage="envelope", pointer="/action_sequence/0/params/speed", got=9.0, allowed=[0.05], hint="slower")
MEMORIES = RetrievedContext(exemplars=(exemplar("best"), exemplar("second", 2)), warnings=(exemplar("burn", rank=1),))

requests = st.builds(
    plan_request,
    st.sampled_from(["put the red cube in the bowl", "put all red things in the bowl", "go to the window", "go home"]),
    contract_id=st.integers(0, 9999).map("c-{:04d}".format),
    robot=st.sampled_from(["panda", "base", "mobile_panda"]),
    registry_hash=st.text("0123456789abcdef", min_size=8, max_size=8),
    recall=st.sampled_from([RetrievedContext(), MEMORIES]),
    rejection=st.sampled_from([None, REJECTED]),
    skills_text=st.sampled_from(["grasp(...)\ngraspable: red_cube", DRIVES, f"{DRIVES}\ngrasp(...)"]),
)
actions = st.lists(
    st.fixed_dictionaries(
        {
            "skill": st.text(max_size=8),
            "params": st.dictionaries(st.text(max_size=8), st.text(max_size=8) | st.floats(0, 1)),
        }
    ),
    max_size=3,
)


def without_header(message: ChatMessage) -> ChatMessage:
    """`message` without id and context in the contract that it shows, and without the id at the end of a question."""
    text = message["content"]
    changed = QUESTION_END.sub("\nContract:", text) if message["role"] == "user" else HEADER.sub("", text)
    assert changed != text
    return {"role": message["role"], "content": changed}


def as_text(sequence: list[dict[str, Any]]) -> str:
    """The text of a model after the given beginning."""
    return json.dumps(sequence, separators=(",", ":")) + "}"


@given(request=requests)
def test_the_local_prompt_is_the_full_prompt_without_id_and_context(request: PlanRequest) -> None:
    assert render_local(request) == [without_header(one) for one in render(request)]


@given(request=requests)
def test_neither_id_nor_registry_is_in_the_local_prompt(request: PlanRequest) -> None:
    shown = [*render_local(request), {"content": LOCAL_FULL_PROMPT.answer_prefix(request)}]
    text = "\n".join(message["content"] for message in shown)
    for fixed in (f'"{request.contract_id}"', f'"{request.registry_hash}"', '"id"', '"context"'):
        assert fixed not in text


@given(request=requests, sequence=actions)
def test_both_formats_give_the_same_text_which_is_the_whole_contract(
    request: PlanRequest, sequence: list[dict[str, Any]]
) -> None:
    rest = as_text(sequence)
    local, full = (
        form.complete(request, form.answer_prefix(request) + rest) for form in (LOCAL_FULL_PROMPT, FULL_PROMPT)
    )
    assert local == full == LOCAL_FULL_PROMPT.contract_prefix(request) + rest
    context = {"robot": request.robot, "registry": request.registry_hash}
    assert json.loads(local) == {"id": request.contract_id, "context": context, "action_sequence": sequence}
    assert list(json.loads(local)) == ["id", "context", "action_sequence"]


@given(
    request=requests, rest=st.text(max_size=40), form=st.sampled_from([LOCAL_FULL_PROMPT, FULL_PROMPT, SHORT_PROMPT])
)
def test_a_text_that_is_cut_or_invalid_has_the_header_exactly_once(request: PlanRequest, rest: str, form: Any) -> None:
    once = form.complete(request, form.answer_prefix(request) + rest)
    assert once == form.contract_prefix(request) + rest
    assert form.complete(request, once) == once
    header = '{"id":' + json.dumps(request.contract_id)
    assert once.startswith(header)
    assert header not in once.removeprefix(header).removesuffix(rest)


@given(request=requests, text=st.sampled_from(["", "{", '{"action', "words", "null"]))
def test_a_text_without_the_given_beginning_is_unchanged(request: PlanRequest, text: str) -> None:
    assert LOCAL_FULL_PROMPT.complete(request, text) == text


@settings(max_examples=5)
@given(request=requests)
def test_the_given_beginning_of_the_local_prompt_has_no_header(request: PlanRequest) -> None:
    assert LOCAL_FULL_PROMPT.answer_prefix(request) == '{"action_sequence":'


def test_each_format_has_its_own_template_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    before = local_template_hash()
    assert len({before, template_hash(), short_template_hash()}) == 3
    assert (LOCAL_FULL_PROMPT.template_hash(), FULL_PROMPT.template_hash()) == (before, template_hash())
    for part, change in (
        ("SYSTEM", "x"),
        ("ARM_EXAMPLES", (DECLINE_EXAMPLE,)),
        ("LOCAL_TEMPLATE_VERSION", 0),
        ("ACTIONS_ONLY", replace(full_prompt.ACTIONS_ONLY, question_end="Answer:")),
        ("ACTIONS_ONLY", replace(full_prompt.ACTIONS_ONLY, answer_format="[]")),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(full_prompt, part, change)
            assert local_template_hash() != before


def test_the_local_prompt_has_its_recorded_bytes() -> None:
    driving = plan_request("go to the window", skills_text=f"{DRIVES}\ngraspable: nothing\nreceptive: window")
    asked = [plan_request(), plan_request(recall=MEMORIES, rejection=REJECTED), driving]
    prompts = json.dumps([render_local(one) for one in asked])
    assert hashlib.sha256(prompts.encode()).hexdigest()[:16] == "20c797f14800d236"
    assert local_template_hash() == "b01c92f4b8db18aa"


def test_a_model_without_a_given_beginning_must_know_id_and_context() -> None:
    with pytest.raises(ValueError, match="id and context"):
        without_constraints(LOCAL_FULL_PROMPT)
    free = without_constraints(FULL_PROMPT)
    assert free.complete(plan_request(), "words") == "words"
    assert free.contract_prefix(plan_request()) == ""
