"""The planner in transformers answers as llama.cpp does, under the same grammar."""

# ruff: noqa: E402  (nothing is imported where the extras are missing)
import itertools
import json

import jsonschema_rs
import msgspec
import pytest

for part in ("torch", "peft", "gguf", "xllamacpp", "llguidance"):
    pytest.importorskip(part, reason="the extras `adapt` and `planner` are not installed")
import torch
from safetensors.torch import load_file, save_file

from dualbrain.adaptation.adapters.card import CONFIG_FILE, WEIGHTS_FILE, hash_weights, write_adapter_card
from dualbrain.adaptation.adapters.stacking import load_stack
from dualbrain.adaptation.serving import transformers_planner
from dualbrain.adaptation.serving.open_planner import open_planner, planner_provenance, start_llama
from dualbrain.adaptation.serving.transformers_planner import TorchConfig, TorchPlanner
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.planner import protocol
from dualbrain.planner.backends.llama_cpp import LlamaConfig
from dualbrain.planner.introspection import planner_template
from dualbrain.planner.prompt import full_prompt
from dualbrain.planner.prompt.full_prompt import local_template_hash
from dualbrain.planner.prompt.prompt_format import (
    FULL_PROMPT,
    LOCAL_FULL_PROMPT,
    SHORT_PROMPT,
    UNCONSTRAINED_SHORT_PROMPT,
)
from dualbrain.planner.prompt.short_prompt import short_template_hash
from tests.adaptation import tiny_adapter, tiny_gguf
from tests.adaptation.tiny_gguf import model
from tests.planner.sample_requests import REGISTRY, plan_request

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")
SHORT_STEPS = {"type": "array", "items": {"enum": ["open", "close"]}, "minItems": 1, "maxItems": 2}
ALL_STEPS = [list(steps) for count in (1, 2) for steps in itertools.product(("open", "close"), repeat=count)]
REQUEST = plan_request(schema={"type": "object", "properties": {"action_sequence": SHORT_STEPS}})


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home with the tiny base and an adapter."""
    tiny_gguf.patch_tokenizer(monkeypatch)
    tiny_adapter.install_base(tmp_path / "cache", monkeypatch)
    tiny_adapter.write_adapter(model("llama"), tmp_path / "fit")
    return tmp_path


def make_planner(home, prompt_format=SHORT_PROMPT, **config):
    stack = load_stack(home / "fit", home / "cache")
    return TorchPlanner("tiny+ab", stack, home / "cache", prompt_format, TorchConfig(**({"max_tokens": 48} | config)))


def test_it_answers_as_llama_cpp_does(home):
    ours = make_planner(home).propose(REQUEST)
    theirs = start_llama(
        load_stack(home / "fit", home / "cache"), home / "cache", LlamaConfig(n_ctx=2048, max_tokens=48)
    )
    try:
        assert theirs.propose(REQUEST).text == ours.text
        assert theirs.messages(REQUEST) == make_planner(home).messages(REQUEST)
    finally:
        theirs.close()
    assert ours.finish_reason == protocol.STOP
    jsonschema_rs.validator_for(REQUEST.schema).validate(json.loads(ours.text))
    assert "llguidance" in ours.constrained_by
    assert "transformers" in ours.constrained_by
    assert make_planner(home).propose(REQUEST).text == ours.text


def test_without_constraints_it_reports_free_decoding(home):
    proposal = make_planner(home, UNCONSTRAINED_SHORT_PROMPT, max_tokens=8).propose(REQUEST)
    assert proposal.finish_reason == protocol.LENGTH
    assert proposal.constrained_by == "nothing (free decoding)"
    assert not proposal.text.startswith('{"id"')


@pytest.fixture
def brief_prompt(monkeypatch):
    """A full prompt that fits into the context of the tiny model."""
    monkeypatch.setattr(full_prompt, "SYSTEM", "{robot}{skills}{form}")
    monkeypatch.setattr(full_prompt, "ARM_EXAMPLES", ())


@pytest.mark.usefixtures("brief_prompt")
@pytest.mark.parametrize("prompt_format", [LOCAL_FULL_PROMPT, FULL_PROMPT])
def test_id_and_context_are_in_every_answer_once(home, prompt_format):
    header = FULL_PROMPT.answer_prefix(REQUEST)
    whole = make_planner(home, prompt_format).propose(REQUEST)
    assert whole.finish_reason == protocol.STOP
    jsonschema_rs.validator_for(REQUEST.schema).validate(json.loads(whole.text))
    assert whole.text in {header + f"{json.dumps(steps, separators=(',', ':'))}}}" for steps in ALL_STEPS}
    assert whole.constrained_by.endswith(prompt_format.header_note)
    cut = make_planner(home, prompt_format, max_tokens=4).propose(REQUEST)
    assert cut.finish_reason == protocol.LENGTH
    assert cut.text == whole.text[: len(header) + 4]
    late = make_planner(home, prompt_format, timeout_s=0.0).propose(REQUEST)
    assert (late.finish_reason, late.text) == (protocol.TIMEOUT, "")


def test_a_time_limit_is_a_finish_reason(home):
    assert make_planner(home, timeout_s=0.0).propose(REQUEST).finish_reason == protocol.TIMEOUT


def test_a_request_outside_the_training_data_is_rejected_before_loading(home, monkeypatch):
    monkeypatch.setattr(transformers_planner, "load_stacked_model", None)
    for wrong in ({"robot": "ur5e"}, {"registry_hash": "00000000"}, {"schema": {"type": "object"}}):
        with pytest.raises(ConfigurationError):
            make_planner(home).propose(plan_request(**wrong))


def test_a_narrower_vocabulary_than_that_of_the_training_is_answered(home):
    options = {"adapters": home / "adapters", "robot": REGISTRY.robot, "registry": "narrower"}
    name = f"transformers:adapter:{home / 'fit'}"
    open_fit = open_planner(name, home / "cache", **options, narrowed_registries={"narrower": REGISTRY.hash})
    asked = msgspec.structs.replace(REQUEST, registry_hash="narrower")
    assert open_fit.propose(asked).text.startswith('{"id":"c-0007","context":{"robot":"panda","registry":"narrower"}')
    with pytest.raises(ConfigurationError, match="was trained for the vocabulary"):
        open_planner(name, home / "cache", **options)


def open_fit(home):
    options = {"adapters": home / "adapters", "robot": REGISTRY.robot, "registry": REGISTRY.hash}
    return open_planner(f"transformers:adapter:{home / 'fit'}", home / "cache", **options)


@pytest.mark.parametrize(
    "changes",
    [{"peft_type": "IA3"}, {"layers_to_transform": [0]}, {"use_dora": True}, {"rank_pattern": {"(a+)+!": 4}}, None],
    ids=str,
)
def test_an_adapter_that_llama_cpp_cannot_serve_is_rejected_when_it_is_opened(home, changes):
    path = home / "fit" / CONFIG_FILE
    path.write_text("{" if changes is None else json.dumps(json.loads(path.read_bytes()) | changes))
    with pytest.raises(ConfigurationError, match="LoRA"):
        open_fit(home)


@pytest.mark.parametrize(
    ("rows", "name", "word"),
    [
        (258, "lm_head", "LoRA layer"),
        (64, "model.layers.7.self_attn.q_proj", "LoRA layer"),
        (1, "model.layers.0.self_attn.q_proj", "LoRA of model.layers.0"),
    ],
)
def test_an_adapter_that_does_not_match_the_base_is_rejected_before_it_answers(home, rows, name, word):
    """A single row would be added to all rows by broadcasting."""
    tensors = load_file(home / "fit" / WEIGHTS_FILE) | {
        f"base_model.model.{name}.lora_{half}.weight": torch.ones(shape)
        for half, shape in (("A", (4, 64)), ("B", (rows, 4)))
    }
    card = load_stack(home / "fit", home / "cache").top_card
    save_file(tensors, home / "fit" / WEIGHTS_FILE)
    write_adapter_card(msgspec.structs.replace(card, id=hash_weights(home / "fit")), home / "fit")
    opened = open_fit(home)
    with pytest.raises(ConfigurationError, match=word):
        opened.propose(REQUEST)


def test_the_planner_is_opened_by_name(home):
    options = {"adapters": home / "adapters", "robot": REGISTRY.robot, "registry": REGISTRY.hash}
    open_fit = open_planner(f"transformers:adapter:{home / 'fit'}", home / "cache", **options)
    assert isinstance(open_fit, TorchPlanner)
    assert open_fit.name.startswith("tiny+")
    bare = open_planner("transformers:tiny", home / "cache", **options)
    assert bare.name == "tiny in torch"
    assert planner_provenance(open_fit) == {"prompt": short_template_hash(), "adapter": open_fit.stack.top_card.id}
    assert planner_provenance(bare) == {"prompt": planner_template(bare)} == {"prompt": local_template_hash()}
    for wrong in ("bse-135m", "", "efficientnet-lite0"):
        with pytest.raises(UnknownNameError, match="base-135m"):
            open_planner(f"transformers:{wrong}", home / "cache", **options)
    with pytest.raises(UnknownNameError):
        open_planner("transformers:unknown", home / "cache", **options)
