"""Serving an adapter: the answers are its own, in its own process, for its robot only, or there are none."""

# ruff: noqa: E402  (nothing is imported where the extras are missing)
import json
import os
import shutil
import signal
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import pytest

for part in ("torch", "peft", "gguf", "xllamacpp"):
    pytest.importorskip(part, reason="the extras `adapt` and `planner` are not installed")
import gguf
import numpy as np
import torch

from dualbrain.adaptation.adapters import packaged
from dualbrain.adaptation.adapters.base_models import base_model_hash, find_base_model
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, write_adapter_card
from dualbrain.adaptation.adapters.promotion import PromotionDecision
from dualbrain.adaptation.adapters.registry import NO_ADAPTER, AdapterRegistry
from dualbrain.adaptation.adapters.stacking import load_stack
from dualbrain.adaptation.conversion import merged_gguf
from dualbrain.adaptation.conversion.gguf_base import write_gguf_file
from dualbrain.adaptation.serving import gguf_cache
from dualbrain.adaptation.serving import open_planner as opening
from dualbrain.adaptation.serving.adapted_planner import AdapterMismatchError
from dualbrain.adaptation.serving.canary import CanaryRecord
from dualbrain.adaptation.serving.gguf_cache import prepare_adapters, prepare_base
from dualbrain.adaptation.serving.open_planner import (
    make_canary_check,
    open_adapter,
    open_planner,
    proposal_author,
    shadow_log_path,
    start_llama,
)
from dualbrain.adaptation.serving.perplexity import perplexity, retention_text
from dualbrain.adaptation.serving.raw_completion import complete
from dualbrain.core import weights
from dualbrain.errors import ChecksumError, ConfigurationError, UnknownNameError
from dualbrain.planner import protocol
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.prompt.prompt_format import SHORT_PROMPT, UNCONSTRAINED_SHORT_PROMPT
from tests.adaptation import tiny_adapter
from tests.adaptation.tiny_gguf import model
from tests.adaptation.tiny_model import tokenizer
from tests.planner.sample_requests import REGISTRY, plan_request

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")
CONFIG = LlamaConfig(n_ctx=2048, max_tokens=24, timeout_s=60.0)
TURNS = [{"role": "user", "content": "what now?"}]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A home with the tiny base in its cache and two adapters in its registry."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        made = tiny_adapter.install_base(home / "cache", patch)
        registry = AdapterRegistry(home / "adapters")
        for seed, name in ((5, "a"), (6, "b")):
            tiny_adapter.write_adapter(model("llama"), home / name, seed)
            registry.add(home / name, now=1.0)
        del made
        yield home


def open_one(home, name, **changed):
    facts = {"adapters": home / "adapters", "robot": REGISTRY.robot, "registry": REGISTRY.hash, "config": CONFIG}
    return open_adapter(name, home / "cache", **(facts | changed))


def ids(home):
    return AdapterRegistry(home / "adapters").ids()


def torch_answer(adapted_model, turns, max_tokens):
    """Greedy tokens of torch, and their margins over the next best [nats]."""
    encoder = tokenizer()
    text = encoder.apply_chat_template(turns, add_generation_prompt=True, tokenize=False)
    tokens, margins = encoder(text, add_special_tokens=False)["input_ids"], []
    start = len(tokens)
    for _ in range(max_tokens):
        with torch.no_grad():
            best = adapted_model(input_ids=torch.tensor([tokens])).logits[0, -1].log_softmax(-1).topk(2)
        margins.append(float(best.values[0] - best.values[1]))
        tokens = [*tokens, int(best.indices[0])]
        if tokens[-1] == 256:
            break
    return tokens[start:], margins


def assert_agrees(completion, tokens, margins):
    """Equal tokens with equal margins; llama.cpp does not report tokens that are only a part of a letter."""
    assert min(margins) > 0.01  # no near-ties
    expected = iter(zip(tokens, margins, strict=True))
    for token_id, margin in zip(completion.tokens, completion.margins, strict=True):
        assert any(
            token_id == token and margin == pytest.approx(expected_margin, abs=0.02)
            for token, expected_margin in expected
        )
    assert len(completion.tokens) > len(tokens) // 3


def test_each_adapter_answers_as_in_torch(home):
    for name in ("a", "b"):
        adapted_model, _ = tiny_adapter.write_adapter(model("llama"), home / f"again-{name}", {"a": 5, "b": 6}[name])
        stack = load_stack(home / f"again-{name}", home / "cache")
        planner = start_llama(stack, home / "cache", CONFIG, prompt_format=UNCONSTRAINED_SHORT_PROMPT)
        try:
            first = complete(planner, TURNS, max_tokens=12)
            complete(planner, [{"role": "user", "content": "something else"}], max_tokens=3)
            assert complete(planner, TURNS, max_tokens=12) == first  # the question in between has no effect
            assert_agrees(first, *torch_answer(adapted_model, TURNS, 12))
            if name == "a":
                text_perplexity = perplexity(planner, retention_text()[:120])
                assert text_perplexity > 10.0
        finally:
            planner.close()


def test_the_card_decides_whether_the_scene_states_values(home, tmp_path):
    request = plan_request(scene_with_values="red_cube: object, free_finger_axis along, opening 0.055")
    for stated in (False, True):
        folder = tmp_path / f"values-{stated}"
        _, card = tiny_adapter.write_adapter(model("llama"), folder, 5)
        write_adapter_card(msgspec.structs.replace(card, scene_values=stated), folder)
        planner = open_one(home, f"adapter:{folder}")
        try:
            assert ("opening 0.055" in str(planner.messages(request))) is stated
        finally:
            planner.close()


def test_stacked_adapters_add_up(home, tmp_path, monkeypatch):
    monkeypatch.setattr(packaged, "PACKAGED_FOLDER", tmp_path)
    lower, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "first")
    assert packaged.packaged_names() == ("first",)
    merged = lower.merge_and_unload()
    upper, _ = tiny_adapter.write_adapter(merged, tmp_path / "second-fit", 6, base="first", base_sha256=card.id)
    stack = load_stack(tmp_path / "second-fit", home / "cache")
    assert stack.layers[0].card == card
    planner = start_llama(stack, home / "cache", CONFIG, prompt_format=UNCONSTRAINED_SHORT_PROMPT)
    try:
        assert [one["scale"] for one in planner.chat_request(plan_request())["lora"]] == [1.0, 1.0]
        assert_agrees(complete(planner, TURNS, max_tokens=12), *torch_answer(upper, TURNS, 12))
    finally:
        planner.close()
    write_adapter_card(msgspec.structs.replace(stack.top_card, base_sha256="0" * 64), tmp_path / "second-fit")
    with pytest.raises(ConfigurationError, match="trained on another first"):
        load_stack(tmp_path / "second-fit", home / "cache")


def test_several_packaged_adapters_are_independent(home, tmp_path, monkeypatch):
    monkeypatch.setattr(packaged, "PACKAGED_FOLDER", tmp_path)
    cards = {
        name: tiny_adapter.write_adapter(model("llama"), tmp_path / name, seed)[1] for seed, name in enumerate("ab", 5)
    }
    assert packaged.packaged_names() == ("a", "b")
    for name, card in cards.items():
        stack = load_stack(packaged.packaged_folder(name), home / "cache")
        assert [layer.card for layer in stack.layers] == [card]
        assert proposal_author(name, stack) == name
        assert find_base_model(name, home / "cache").stacked_on_id == base_model_hash(name) == card.id


def test_an_adapter_proposes_under_the_grammar_with_base_and_id_as_author(home):
    name = ids(home)[0]
    planner = open_one(home, f"adapter:{name[:12]}")
    try:
        proposal = planner.propose(plan_request())
        assert proposal.finish_reason in {protocol.STOP, protocol.LENGTH}
        assert proposal.planner == planner.name == f"tiny+{name[:16]}"
        assert proposal.text.startswith('{"id":"c-0007","context":{"robot":"panda","registry":')
        assert proposal.text.split('"action_sequence')[1].startswith('":[{"skill":"')
        assert "llguidance" in proposal.constrained_by
        assert planner.propose(plan_request()).text == proposal.text
        for wrong in ({"robot": "ur5e"}, {"registry_hash": "00000000"}):
            with pytest.raises(ConfigurationError, match=f"Adapter {name[:16]} was trained for"):
                planner.propose(plan_request(**wrong))
    finally:
        planner.close()


def test_every_request_lists_all_adapters_and_uses_no_prompt_cache(home):
    stack = load_stack(AdapterRegistry(home / "adapters").folder / ids(home)[0], home / "cache")
    for prompt_format in (SHORT_PROMPT, UNCONSTRAINED_SHORT_PROMPT):
        planner = start_llama(stack, home / "cache", CONFIG, prompt_format=prompt_format)
        body = planner.chat_request(plan_request())
        planner.close()
        assert body["lora"] == [{"id": 0, "scale": 1.0}]
        assert body["cache_prompt"] is False
        assert ("grammar" in body) is (prompt_format is SHORT_PROMPT)


def test_a_narrower_vocabulary_than_that_of_the_training_is_served(home):
    """The gate rejects everything outside the narrower vocabulary."""
    planner = open_one(
        home, f"adapter:{ids(home)[0]}", registry="narrower", narrowed_registries={"narrower": REGISTRY.hash}
    )
    try:
        assert '"registry":"narrower"' in planner.propose(plan_request(registry_hash="narrower")).text
        with pytest.raises(ConfigurationError, match="was trained for the vocabulary"):
            planner.propose(plan_request(registry_hash="00000000"))
    finally:
        planner.close()


@pytest.mark.parametrize("wrong", [{"robot": "ur5e"}, {"registry": "00000000"}])
def test_another_robot_or_vocabulary_is_rejected_before_a_process_starts(home, wrong):
    with pytest.raises(ConfigurationError, match=r"was trained for panda|was trained for the vocabulary"):
        open_one(home, f"adapter:{ids(home)[0]}", **wrong)


def test_another_prompt_or_base_and_changed_weights_are_rejected(home, tmp_path):
    _, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "c", 7)
    for changed, word in (
        ({"prompt": "old"}, "was trained with the prompt template"),
        ({"base_sha256": "0" * 64}, "was trained on another tiny"),
        ({"base": "unheard"}, "unheard"),
    ):
        write_adapter_card(msgspec.structs.replace(card, **changed), tmp_path / "c")
        with pytest.raises((ConfigurationError, UnknownNameError), match=word):
            open_one(home, f"adapter:{tmp_path / 'c'}")
    write_adapter_card(card, tmp_path / "c")
    (tmp_path / "c" / WEIGHTS_FILE).write_bytes(b"others")
    with pytest.raises(ConfigurationError, match="were changed"):
        open_one(home, f"adapter:{tmp_path / 'c'}")
    base = home / "cache" / "tiny.gguf"
    whole = base.read_bytes()
    base.write_bytes(whole[:-1] + b"x")
    try:
        with pytest.raises(ChecksumError):
            open_one(home, f"adapter:{ids(home)[0]}")
    finally:
        base.write_bytes(whole)
    assert all(fault == "" for fault in AdapterRegistry(home / "adapters").verify().values())


def test_equal_weights_with_another_alpha_have_another_file_and_another_canary(home, tmp_path):
    """The id covers the weights only, and α is not among them."""
    stack = load_stack(AdapterRegistry(home / "adapters").folder / ids(home)[0], home / "cache")
    other = tmp_path / "louder"
    shutil.copytree(stack.layers[-1].folder, other)
    config = json.loads((other / "adapter_config.json").read_bytes())
    (other / "adapter_config.json").write_text(json.dumps(config | {"lora_alpha": 10 * config["lora_alpha"]}))
    louder = load_stack(other, home / "cache")
    assert louder.top_card.id == stack.top_card.id
    paths = [prepare_adapters(one, home / "cache")[0].path for one in (louder, stack)]
    assert paths[0] != paths[1]
    assert paths[0].read_bytes() != paths[1].read_bytes()
    planner = SimpleNamespace(model=home / "cache" / "tiny.gguf")
    checks = [make_canary_check(planner, one, home / "cache", home / "adapters", CONFIG) for one in (louder, stack)]
    assert checks[0].path != checks[1].path


def test_an_incomplete_file_in_the_cache_is_made_again(home):
    stack = load_stack(AdapterRegistry(home / "adapters").folder / ids(home)[0], home / "cache")
    path = prepare_adapters(stack, home / "cache")[0].path
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    assert prepare_adapters(stack, home / "cache")[0].path.read_bytes() == whole


def test_a_small_quantised_base_is_served_in_float16_and_any_other_unchanged(home, tmp_path, monkeypatch):
    stack = load_stack(AdapterRegistry(home / "adapters").folder / ids(home)[0], home / "cache")
    assert prepare_base(stack, tmp_path) == stack.gguf  # float32 already
    packed = replace(stack, gguf=quantised(stack.gguf, tmp_path / "packed.gguf"))
    path = prepare_base(packed, tmp_path)
    assert (
        prepare_base(replace(packed, layers=()), tmp_path) == path
    )  # the same base without the adapter, for comparisons
    for converted, original in zip(gguf.GGUFReader(path).tensors, gguf.GGUFReader(packed.gguf).tensors, strict=True):
        whole = gguf.quants.dequantize(original.data, original.tensor_type)
        assert np.array_equal(converted.data, whole.astype(np.float16) if whole.ndim > 1 else whole)
    path.write_bytes(path.read_bytes()[:-8])
    assert gguf.GGUFReader(prepare_base(packed, tmp_path)).tensors
    planner = start_llama(packed, tmp_path, CONFIG, prompt_format=UNCONSTRAINED_SHORT_PROMPT)
    assert planner.model == path
    planner.close()
    monkeypatch.setattr(gguf_cache, "read_gguf_base", None)  # it takes seconds, and must not be called again
    assert prepare_base(packed, tmp_path) == path
    monkeypatch.setattr(gguf_cache, "MAX_HALF_PRECISION_BYTES", 1000.0)
    assert prepare_base(packed, tmp_path) == packed.gguf


def quantised(base, out):
    """The GGUF `base` with all matrices in Q8_0."""
    reader, writer, kind = gguf.GGUFReader(base), gguf.GGUFWriter(out, "llama"), gguf.GGMLQuantizationType.Q8_0
    for key, field in reader.fields.items():
        if key not in merged_gguf.WRITER_KEYS:
            merged_gguf._copy_field(writer, key, field)
    for tensor in reader.tensors:
        if tensor.data.ndim > 1:
            writer.add_tensor(tensor.name, gguf.quants.quantize(tensor.data, kind), raw_dtype=kind)
        else:
            writer.add_tensor(tensor.name, tensor.data)
    write_gguf_file(writer)
    return out


def test_adapters_are_opened_by_name_and_unknown_names_list_the_known_ones(home):
    registry, (first, second) = AdapterRegistry(home / "adapters"), ids(home)
    with pytest.raises(ConfigurationError, match="champion of panda"):
        open_one(home, "adapter:champion")
    card = registry.card(first)
    registry.promote(first, PromotionDecision(candidate=first, champion=NO_ADAPTER, measures={}, against=()), now=2.0)
    planner = open_one(home, "adapter:champion")
    assert planner.card == card
    planner.close()
    registry.roll_back((card.robot, card.base_sha256), "a test", now=3.0)
    for name, known in (
        ("adapter:zz", first[:16]),
        ("unknown", r"a GGUF file or URL also works.*base-135m.*shadow:.*transformers:"),
        ("foo+http://h/v1", "not a dialect.*vllm"),
        ("transformers:unknown", "not a planner in torch.*adapter:champion"),
        ("shadow:zz", first[:16]),
        (f"shadow:{first}@foo+http://h/v1", "not a dialect.*vllm"),
    ):
        with pytest.raises(UnknownNameError, match=known):
            open_planner(name, home / "cache", adapters=home / "adapters", robot="panda", registry=REGISTRY.hash)
    assert second != first


# --- canaries -------------------------------------------------------------------------------------------------------


@pytest.fixture
def own_registry(home, tmp_path):
    """A home with a separate registry that contains the adapter a, and the card of that adapter."""
    registry = AdapterRegistry(tmp_path / "adapters")
    card = registry.add(home / "a", now=1.0)
    return tmp_path, card


def test_a_canary_is_recorded_once_and_compared_at_every_start(home, own_registry):
    own_home, card = own_registry
    for _ in range(2):
        open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters").close()
    (path,) = (own_home / "adapters" / "canaries").iterdir()
    record = msgspec.json.decode(path.read_bytes(), type=CanaryRecord)
    assert record.adapter == card.id
    assert "xllamacpp" in record.runtime
    assert min(record.canaries[0].margins) >= 0.05
    record_fields = json.loads(path.read_text())
    shifted = [margin + 1.0 for margin in record_fields["canaries"][0]["margins"]]
    for wrong in ({"tokens": [1] * len(shifted)}, {"margins": shifted}):
        record_fields["canaries"][0] |= wrong
        path.write_text(json.dumps(record_fields))
        with pytest.raises(AdapterMismatchError, match="does not answer as recorded"):
            open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters")


@pytest.mark.parametrize(
    "damage",
    [
        lambda fields: "{",
        lambda fields: "",
        lambda fields: '"\xff',
        lambda fields: "[" * 100_000,
        lambda fields: json.dumps(fields | {"adapter": "b" * 64}),
        lambda fields: json.dumps(fields | {"runtime": "another"}),
        lambda fields: json.dumps(fields | {"canaries": []}),
        lambda fields: json.dumps(fields | {"canaries": [fields["canaries"][0] | {"tokens": [], "margins": []}]}),
        lambda fields: json.dumps(fields | {"canaries": [fields["canaries"][0] | {"margins": []}]}),
        lambda fields: json.dumps(fields | {"canaries": [fields["canaries"][0] | {"question": 4}]}),
    ],
    ids=["cut", "empty", "no text", "too deep", "adapter", "runtime", "none", "no tokens", "no margins", "question"],
)
def test_a_damaged_record_is_a_configuration_error_and_not_overwritten(home, own_registry, processes, damage):
    own_home, card = own_registry
    open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters").close()
    (path,) = (own_home / "adapters" / "canaries").iterdir()
    path.write_text(damage(json.loads(path.read_text())), "latin-1")
    damaged = path.read_bytes()
    with pytest.raises(ConfigurationError, match=f"canary record of adapter {card.id[:16]}.*delete it.*{path}"):
        open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters")
    assert path.read_bytes() == damaged
    assert not any(map(is_running, processes))


def test_a_record_that_is_damaged_while_serving_is_the_finish_reason(home, own_registry):
    own_home, card = own_registry
    planner = open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters")
    try:
        os.kill(planner._inner.pid, signal.SIGKILL)
        assert planner.propose(plan_request()).finish_reason.startswith(f"{protocol.CRASHED}: signal 9")
        (path,) = (own_home / "adapters" / "canaries").iterdir()
        path.write_text("{")
        reason = planner.propose(plan_request()).finish_reason
        assert "the adapter does not answer as recorded: The canary record of adapter" in reason
    finally:
        planner.close()


@pytest.fixture
def processes(monkeypatch):
    """All processes that are started from now on."""
    started = []

    def start(planner):
        started.append(original(planner))
        return started[-1]

    original = LlamaPlanner._start
    monkeypatch.setattr(LlamaPlanner, "_start", start)
    return started


def is_running(process):
    return process._process.poll() is None


def test_a_failure_while_opening_leaves_no_process(home, tmp_path, processes, monkeypatch):
    adapters, (first, second) = home / "adapters", ids(home)
    options = {"adapters": adapters, "robot": REGISTRY.robot, "registry": REGISTRY.hash}
    with pytest.raises(UnknownNameError, match="unknown"):
        open_planner(f"shadow:{first}@unknown", home / "cache", **options)
    assert len(processes) > 0
    log = shadow_log_path(adapters, first)
    log.mkdir(parents=True)
    with pytest.raises(ConfigurationError, match="shadow log cannot be written"):
        open_planner(f"shadow:{first}@adapter:{second}", home / "cache", **options)
    log.rmdir()
    before = len(processes)
    monkeypatch.setattr(opening, "runtime_name", lambda model: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        open_one(home, f"adapter:{first}")
    assert len(processes) == before + 1
    assert not any(map(is_running, processes))


def test_a_process_with_another_adapter_is_detected(home, own_registry, monkeypatch):
    own_home, card = own_registry
    open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters").close()
    stack = load_stack(own_home / "adapters" / card.id, home / "cache")
    other = prepare_adapters(load_stack(home / "b", home / "cache"), home / "cache")[0].path
    path = prepare_adapters(stack, home / "cache")[0].path
    kept = path.read_bytes()
    shutil.copyfile(other, path)
    monkeypatch.setattr("dualbrain.adaptation.serving.gguf_cache.file_sha256", lambda path: "as it should be")
    path.with_suffix(".sha256").write_text("as it should be")
    with pytest.raises(AdapterMismatchError, match="canary"):
        open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters")
    path.write_bytes(kept)
    monkeypatch.undo()
    path.with_suffix(".sha256").unlink()


def test_an_adapter_without_effect_is_rejected(home, tmp_path):
    _, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "nothing", size=0.0)
    with pytest.raises(AdapterMismatchError, match="as if no adapter"):
        open_one(home, f"adapter:{tmp_path / 'nothing'}", adapters=tmp_path / "adapters")
    assert card.base == "tiny"


def test_a_restarted_process_is_checked_again(home, own_registry):
    own_home, card = own_registry
    planner = open_one(home, f"adapter:{card.id}", adapters=own_home / "adapters")
    try:
        os.kill(planner._inner.pid, signal.SIGKILL)
        assert planner.propose(plan_request()).finish_reason.startswith(f"{protocol.CRASHED}: signal 9 (Killed)")
        (path,) = (own_home / "adapters" / "canaries").iterdir()
        record_fields = json.loads(path.read_text())
        record_fields["canaries"][0]["tokens"][0] = 1
        path.write_text(json.dumps(record_fields))
        assert "the adapter does not answer as recorded" in planner.propose(plan_request()).finish_reason
    finally:
        planner.close()
    assert weights.find_weight_file("tiny").sha256 == card.base_sha256
