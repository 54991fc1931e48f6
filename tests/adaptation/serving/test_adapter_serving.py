"""An adapter that serves: it answers as itself, in its own process, where it was made for, or not at all."""

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
def place(tmp_path_factory):
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


def opened(place, name, **changed):
    facts = {"adapters": place / "adapters", "robot": REGISTRY.robot, "registry": REGISTRY.hash, "config": CONFIG}
    return open_adapter(name, place / "cache", **(facts | changed))


def ids(place):
    return AdapterRegistry(place / "adapters").ids()


def of_torch(worn_model, turns, longest):
    """Greedy tokens of torch, and by how much each was above the next best [nats]."""
    coder = tokenizer()
    text = coder.apply_chat_template(turns, add_generation_prompt=True, tokenize=False)
    tokens, margins = coder(text, add_special_tokens=False)["input_ids"], []
    start = len(tokens)
    for _ in range(longest):
        with torch.no_grad():
            best = worn_model(input_ids=torch.tensor([tokens])).logits[0, -1].log_softmax(-1).topk(2)
        margins.append(float(best.values[0] - best.values[1]))
        tokens = [*tokens, int(best.indices[0])]
        if tokens[-1] == 256:
            break
    return tokens[start:], margins


def agrees(said, tokens, margins):
    """Equal tokens, as sure of each; those that are only a part of a letter are not told by llama.cpp."""
    assert min(margins) > 0.01  # no near-tie among them
    theirs = iter(zip(tokens, margins, strict=True))
    for ours, margin in zip(said.tokens, said.margins, strict=True):
        assert any(ours == token and margin == pytest.approx(sure, abs=0.02) for token, sure in theirs)
    assert len(said.tokens) > len(tokens) // 3


def test_it_answers_as_torch_does_and_another_adapter_as_itself(place):
    for name in ("a", "b"):
        worn_model, _ = tiny_adapter.write_adapter(model("llama"), place / f"again-{name}", {"a": 5, "b": 6}[name])
        stack = load_stack(place / f"again-{name}", place / "cache")
        planner = start_llama(stack, place / "cache", CONFIG, prompt_format=UNCONSTRAINED_SHORT_PROMPT)
        try:
            first = complete(planner, TURNS, max_tokens=12)
            complete(planner, [{"role": "user", "content": "something else"}], max_tokens=3)
            assert complete(planner, TURNS, max_tokens=12) == first  # nothing is left of what was asked between
            agrees(first, *of_torch(worn_model, TURNS, 12))
            if name == "a":
                told = perplexity(planner, retention_text()[:120])
                assert told > 10.0
        finally:
            planner.close()


def test_an_adapter_on_an_adapter_is_the_sum_of_both(place, tmp_path, monkeypatch):
    monkeypatch.setattr(packaged, "PACKAGED_FOLDER", tmp_path)
    lower, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "first")
    assert packaged.packaged_names() == ("first",)
    merged = lower.merge_and_unload()
    upper, _ = tiny_adapter.write_adapter(merged, tmp_path / "second-fit", 6, base="first", base_sha256=card.id)
    stack = load_stack(tmp_path / "second-fit", place / "cache")
    assert stack.layers[0].card == card
    planner = start_llama(stack, place / "cache", CONFIG, prompt_format=UNCONSTRAINED_SHORT_PROMPT)
    try:
        assert [one["scale"] for one in planner.chat_request(plan_request())["lora"]] == [1.0, 1.0]
        agrees(complete(planner, TURNS, max_tokens=12), *of_torch(upper, TURNS, 12))
    finally:
        planner.close()
    write_adapter_card(msgspec.structs.replace(stack.top_card, base_sha256="0" * 64), tmp_path / "second-fit")
    with pytest.raises(ConfigurationError, match="made for another first"):
        load_stack(tmp_path / "second-fit", place / "cache")


def test_several_packaged_ones_stand_beside_each_other(place, tmp_path, monkeypatch):
    monkeypatch.setattr(packaged, "PACKAGED_FOLDER", tmp_path)
    cards = {
        name: tiny_adapter.write_adapter(model("llama"), tmp_path / name, seed)[1] for seed, name in enumerate("ab", 5)
    }
    assert packaged.packaged_names() == ("a", "b")
    for name, card in cards.items():
        stack = load_stack(packaged.packaged_folder(name), place / "cache")
        assert [layer.card for layer in stack.layers] == [card]
        assert proposal_author(name, stack) == name
        assert find_base_model(name, place / "cache").stacked_on_id == base_model_hash(name) == card.id


def test_it_proposes_under_the_grammar_and_signs_with_base_and_id(place):
    name = ids(place)[0]
    planner = opened(place, f"adapter:{name[:12]}")
    try:
        proposal = planner.propose(plan_request())
        assert proposal.finish_reason in {protocol.STOP, protocol.LENGTH}
        assert proposal.planner == planner.name == f"tiny+{name[:16]}"
        assert proposal.text.startswith('{"id":"c-0007","context":{"robot":"panda","registry":')
        assert proposal.text.split('"action_sequence')[1].startswith('":[{"skill":"')
        assert "llguidance" in proposal.constrained_by
        assert planner.propose(plan_request()).text == proposal.text
        for wrong in ({"robot": "ur5e"}, {"registry_hash": "00000000"}):
            with pytest.raises(ConfigurationError, match=f"of adapter {name[:16]}"):
                planner.propose(plan_request(**wrong))
    finally:
        planner.close()


def test_every_request_names_every_adapter_and_uses_nothing_that_was_read_before(place):
    stack = load_stack(AdapterRegistry(place / "adapters").folder / ids(place)[0], place / "cache")
    for asking in (SHORT_PROMPT, UNCONSTRAINED_SHORT_PROMPT):
        planner = start_llama(stack, place / "cache", CONFIG, prompt_format=asking)
        asked = planner.chat_request(plan_request())
        planner.close()
        assert asked["lora"] == [{"id": 0, "scale": 1.0}]
        assert asked["cache_prompt"] is False
        assert ("grammar" in asked) is (asking is SHORT_PROMPT)


def test_a_vocabulary_that_only_narrows_what_it_was_taught_is_served(place):
    """The gate stands before the robot and refuses what is outside."""
    planner = opened(place, f"adapter:{ids(place)[0]}", registry="narrower", narrowed={"narrower": REGISTRY.hash})
    try:
        assert '"registry":"narrower"' in planner.propose(plan_request(registry_hash="narrower")).text
        with pytest.raises(ConfigurationError, match="vocabulary of adapter"):
            planner.propose(plan_request(registry_hash="00000000"))
    finally:
        planner.close()


@pytest.mark.parametrize("wrong", [{"robot": "ur5e"}, {"registry": "00000000"}])
def test_another_robot_or_vocabulary_is_refused_before_anything_starts(place, wrong):
    with pytest.raises(ConfigurationError, match="of adapter"):
        opened(place, f"adapter:{ids(place)[0]}", **wrong)


def test_another_prompt_or_base_and_changed_weights_are_refused(place, tmp_path):
    _, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "c", 7)
    for changed, word in (
        ({"prompt": "old"}, "prompt of adapter"),
        ({"base_sha256": "0" * 64}, "hash of the base"),
        ({"base": "unheard"}, "unheard"),
    ):
        write_adapter_card(msgspec.structs.replace(card, **changed), tmp_path / "c")
        with pytest.raises((ConfigurationError, UnknownNameError), match=word):
            opened(place, f"adapter:{tmp_path / 'c'}")
    write_adapter_card(card, tmp_path / "c")
    (tmp_path / "c" / WEIGHTS_FILE).write_bytes(b"others")
    with pytest.raises(ConfigurationError, match="were changed"):
        opened(place, f"adapter:{tmp_path / 'c'}")
    base = place / "cache" / "tiny.gguf"
    whole = base.read_bytes()
    base.write_bytes(whole[:-1] + b"x")
    try:
        with pytest.raises(ChecksumError):
            opened(place, f"adapter:{ids(place)[0]}")
    finally:
        base.write_bytes(whole)
    assert all(fault == "" for fault in AdapterRegistry(place / "adapters").verify().values())


def test_the_same_weights_worn_otherwise_are_another_file_and_another_canary(place, tmp_path):
    """The id covers the weights, and α is not among them."""
    stack = load_stack(AdapterRegistry(place / "adapters").folder / ids(place)[0], place / "cache")
    other = tmp_path / "louder"
    shutil.copytree(stack.layers[-1].folder, other)
    config = json.loads((other / "adapter_config.json").read_bytes())
    (other / "adapter_config.json").write_text(json.dumps(config | {"lora_alpha": 10 * config["lora_alpha"]}))
    louder = load_stack(other, place / "cache")
    assert louder.top_card.id == stack.top_card.id
    paths = [prepare_adapters(one, place / "cache")[0].path for one in (louder, stack)]
    assert paths[0] != paths[1]
    assert paths[0].read_bytes() != paths[1].read_bytes()
    planner = SimpleNamespace(model=place / "cache" / "tiny.gguf")
    watches = [make_canary_check(planner, one, place / "cache", place / "adapters", CONFIG) for one in (louder, stack)]
    assert watches[0].path != watches[1].path


def test_a_torn_file_in_the_cache_is_made_again(place):
    stack = load_stack(AdapterRegistry(place / "adapters").folder / ids(place)[0], place / "cache")
    path = prepare_adapters(stack, place / "cache")[0].path
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    assert prepare_adapters(stack, place / "cache")[0].path.read_bytes() == whole


def test_a_small_quantised_base_is_served_in_float16_and_any_other_as_it_is(place, tmp_path, monkeypatch):
    stack = load_stack(AdapterRegistry(place / "adapters").folder / ids(place)[0], place / "cache")
    assert prepare_base(stack, tmp_path) == stack.gguf  # float32 already
    packed = replace(stack, gguf=quantised(stack.gguf, tmp_path / "packed.gguf"))
    path = prepare_base(packed, tmp_path)
    assert (
        prepare_base(replace(packed, layers=()), tmp_path) == path
    )  # what is below the adapter, too: it is compared with
    for ours, theirs in zip(gguf.GGUFReader(path).tensors, gguf.GGUFReader(packed.gguf).tensors, strict=True):
        whole = gguf.quants.dequantize(theirs.data, theirs.tensor_type)
        assert np.array_equal(ours.data, whole.astype(np.float16) if whole.ndim > 1 else whole)
    path.write_bytes(path.read_bytes()[:-8])
    assert gguf.GGUFReader(prepare_base(packed, tmp_path)).tensors
    planner = start_llama(packed, tmp_path, CONFIG, prompt_format=UNCONSTRAINED_SHORT_PROMPT)
    assert planner.model == path
    planner.close()
    monkeypatch.setattr(gguf_cache, "read_gguf_base", None)  # takes seconds, and is not needed again
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


def test_names(place):
    registry, (first, second) = AdapterRegistry(place / "adapters"), ids(place)
    with pytest.raises(ConfigurationError, match="champion of panda"):
        opened(place, "adapter:champion")
    card = registry.card(first)
    registry.promote(first, PromotionDecision(candidate=first, champion=NO_ADAPTER, measures={}, against=()), now=2.0)
    planner = opened(place, "adapter:champion")
    assert planner.card == card
    planner.close()
    registry.roll_back((card.robot, card.base_sha256), "a test", now=3.0)
    for name, known in (
        ("adapter:zz", first[:16]),
        ("nobody", r"a GGUF file or URL also works.*base-135m.*shadow:.*transformers:"),
        ("foo+http://h/v1", "not a dialect.*vllm"),
        ("transformers:nobody", "not a planner in torch.*adapter:champion"),
        ("shadow:zz", first[:16]),
        (f"shadow:{first}@foo+http://h/v1", "not a dialect.*vllm"),
    ):
        with pytest.raises(UnknownNameError, match=known):
            open_planner(name, place / "cache", adapters=place / "adapters", robot="panda", registry=REGISTRY.hash)
    assert second != first


# --- canaries -------------------------------------------------------------------------------------------------------


@pytest.fixture
def apart(place, tmp_path):
    """A registry of its own with the adapter a."""
    registry = AdapterRegistry(tmp_path / "adapters")
    card = registry.add(place / "a", now=1.0)
    return tmp_path, card


def test_a_canary_is_recorded_once_and_compared_at_every_start(place, apart):
    home, card = apart
    for _ in range(2):
        opened(place, f"adapter:{card.id}", adapters=home / "adapters").close()
    (path,) = (home / "adapters" / "canaries").iterdir()
    record = msgspec.json.decode(path.read_bytes(), type=CanaryRecord)
    assert record.adapter == card.id
    assert "xllamacpp" in record.runtime
    assert min(record.canaries[0].margins) >= 0.05
    told = json.loads(path.read_text())
    shifted = [margin + 1.0 for margin in told["canaries"][0]["margins"]]
    for wrong in ({"tokens": [1] * len(shifted)}, {"margins": shifted}):
        told["canaries"][0] |= wrong
        path.write_text(json.dumps(told))
        with pytest.raises(AdapterMismatchError, match="does not answer as it did"):
            opened(place, f"adapter:{card.id}", adapters=home / "adapters")


@pytest.mark.parametrize(
    "damage",
    [
        lambda told: "{",
        lambda told: "",
        lambda told: '"\xff',
        lambda told: "[" * 100_000,
        lambda told: json.dumps(told | {"adapter": "b" * 64}),
        lambda told: json.dumps(told | {"runtime": "another"}),
        lambda told: json.dumps(told | {"canaries": []}),
        lambda told: json.dumps(told | {"canaries": [told["canaries"][0] | {"tokens": [], "margins": []}]}),
        lambda told: json.dumps(told | {"canaries": [told["canaries"][0] | {"margins": []}]}),
        lambda told: json.dumps(told | {"canaries": [told["canaries"][0] | {"question": 4}]}),
    ],
    ids=["torn", "empty", "no text", "too deep", "adapter", "runtime", "none", "no tokens", "no margins", "question"],
)
def test_a_damaged_record_is_a_broken_setup_and_not_recorded_anew(place, apart, processes, damage):
    home, card = apart
    opened(place, f"adapter:{card.id}", adapters=home / "adapters").close()
    (path,) = (home / "adapters" / "canaries").iterdir()
    path.write_text(damage(json.loads(path.read_text())), "latin-1")
    damaged = path.read_bytes()
    with pytest.raises(ConfigurationError, match=f"canaries of adapter {card.id[:16]}.*delete it.*{path}"):
        opened(place, f"adapter:{card.id}", adapters=home / "adapters")
    assert path.read_bytes() == damaged
    assert not any(map(runs, processes))


def test_a_record_that_is_damaged_while_it_serves_is_why_there_is_no_answer(place, apart):
    home, card = apart
    planner = opened(place, f"adapter:{card.id}", adapters=home / "adapters")
    try:
        os.kill(planner._inner.pid, signal.SIGKILL)
        assert planner.propose(plan_request()).finish_reason.startswith(f"{protocol.CRASHED}: signal 9")
        (path,) = (home / "adapters" / "canaries").iterdir()
        path.write_text("{")
        assert "not the adapter it was: canaries of adapter" in planner.propose(plan_request()).finish_reason
    finally:
        planner.close()


@pytest.fixture
def processes(monkeypatch):
    """All processes that are started from now on."""
    started = []

    def start(planner):
        started.append(begin(planner))
        return started[-1]

    begin = LlamaPlanner._start
    monkeypatch.setattr(LlamaPlanner, "_start", start)
    return started


def runs(process):
    return process._process.poll() is None


def test_whatever_fails_while_it_is_opened_no_process_is_left(place, tmp_path, processes, monkeypatch):
    adapters, (first, second) = place / "adapters", ids(place)
    told = {"adapters": adapters, "robot": REGISTRY.robot, "registry": REGISTRY.hash}
    with pytest.raises(UnknownNameError, match="nobody"):
        open_planner(f"shadow:{first}@nobody", place / "cache", **told)
    assert len(processes) > 0
    log = shadow_log_path(adapters, first)
    log.mkdir(parents=True)
    with pytest.raises(ConfigurationError, match="log of the shadow"):
        open_planner(f"shadow:{first}@adapter:{second}", place / "cache", **told)
    log.rmdir()
    before = len(processes)
    monkeypatch.setattr(opening, "runtime_of", lambda model: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        opened(place, f"adapter:{first}")
    assert len(processes) == before + 1
    assert not any(map(runs, processes))


def test_a_process_that_wears_another_adapter_is_found_out(place, apart, monkeypatch):
    home, card = apart
    opened(place, f"adapter:{card.id}", adapters=home / "adapters").close()
    stack = load_stack(home / "adapters" / card.id, place / "cache")
    other = prepare_adapters(load_stack(place / "b", place / "cache"), place / "cache")[0].path
    path = prepare_adapters(stack, place / "cache")[0].path
    kept = path.read_bytes()
    shutil.copyfile(other, path)
    monkeypatch.setattr("dualbrain.adaptation.serving.gguf_cache._file_hash", lambda path: "as it should be")
    path.with_suffix(".sha256").write_text("as it should be")
    with pytest.raises(AdapterMismatchError, match="canary"):
        opened(place, f"adapter:{card.id}", adapters=home / "adapters")
    path.write_bytes(kept)
    monkeypatch.undo()
    path.with_suffix(".sha256").unlink()


def test_an_adapter_without_effect_is_refused(place, tmp_path):
    _, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "nothing", size=0.0)
    with pytest.raises(AdapterMismatchError, match="as if no adapter"):
        opened(place, f"adapter:{tmp_path / 'nothing'}", adapters=tmp_path / "adapters")
    assert card.base == "tiny"


def test_a_process_that_was_started_anew_is_asked_again(place, apart):
    home, card = apart
    planner = opened(place, f"adapter:{card.id}", adapters=home / "adapters")
    try:
        os.kill(planner._inner.pid, signal.SIGKILL)
        assert planner.propose(plan_request()).finish_reason.startswith(f"{protocol.CRASHED}: signal 9 (Killed)")
        (path,) = (home / "adapters" / "canaries").iterdir()
        told = json.loads(path.read_text())
        told["canaries"][0]["tokens"][0] = 1
        path.write_text(json.dumps(told))
        assert "not the adapter it was" in planner.propose(plan_request()).finish_reason
    finally:
        planner.close()
    assert weights.find_weight_file("tiny").sha256 == card.base_sha256
