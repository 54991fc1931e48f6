"""The converter: llama.cpp computes the same as torch with the adapter; everything else is rejected with its name."""

# ruff: noqa: E402  (nothing is imported where the extras are missing)
import dataclasses
import json
import math
import os
import resource
import shutil
import urllib.request

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

for part in ("torch", "peft", "gguf", "xllamacpp"):
    pytest.importorskip(part, reason="the extras `adapt` and `planner` are not installed")
import gguf
import torch
import xllamacpp
from peft import LoraConfig
from safetensors.torch import load_file, save_file

from dualbrain.adaptation.conversion.gguf_lora import convert_adapter, permute_rows
from dualbrain.adaptation.conversion.peft_lora import (
    CONFIG_FILE,
    KNOWN_SETTINGS,
    PLAIN_VALUES,
    WEIGHTS_FILE,
    read_lora,
    require_plain_lora,
)
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.errors import ConfigurationError, MissingDependencyError
from tests.adaptation.tiny_gguf import KINDS, interleave_rows, model, random_adapter, write_gguf

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")
PROMPT = [10, 20, 30, 200, 7, 99, 31, 64]


def torch_log_probs(adapted):
    with torch.no_grad():
        logits = adapted(input_ids=torch.tensor([PROMPT]), use_cache=False).logits[0, -1]
    return logits.double().log_softmax(-1).numpy()


def llama_log_probs(base, adapter, scale=1.0):
    """Log-probabilities of the next token in llama.cpp, with float32 caches."""
    params = xllamacpp.CommonParams()
    params.model.path = str(base)
    params.n_ctx, params.n_parallel, params.cache_ram_mib = 256, 1, 0
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = 1
    params.warmup, params.verbosity = False, 0
    params.cache_type_k = params.cache_type_v = xllamacpp.ggml_type.GGML_TYPE_F32
    params.flash_attn_type = xllamacpp.llama_flash_attn_type.LLAMA_FLASH_ATTN_TYPE_DISABLED
    if adapter is not None:
        params.lora_adapters = [xllamacpp.CommonAdapterLoraInfo(str(adapter), 1.0)]
        params.lora_init_without_apply = True
    server = xllamacpp.Server(params)
    body = {"prompt": PROMPT, "n_predict": 1, "n_probs": 258, "temperature": 0.0}
    body |= {"lora": [{"id": 0, "scale": scale}]} if adapter is not None else {}
    request = urllib.request.Request(f"{server.listening_address}/completion", json.dumps(body).encode())
    with urllib.request.urlopen(request, timeout=30) as answer:
        top_logprobs = json.loads(answer.read())["completion_probabilities"][0]["top_logprobs"]
    found = np.full(258, -math.inf)
    for one in top_logprobs:
        found[one["id"]] = one["logprob"]
    return found


@pytest.mark.parametrize("architecture", KINDS)
@pytest.mark.parametrize(
    "changed",
    [{}, {"use_rslora": True, "rank_pattern": {"layers.0.self_attn.k_proj": 2}, "alpha_pattern": {"down_proj": 5}}],
    ids=["plain", "rank-stabilised with patterns"],
)
def test_llama_cpp_computes_the_same_as_torch(architecture, changed, tmp_path):
    made = model(architecture)
    base = write_gguf(made, architecture, tmp_path / "base.gguf")
    bare = torch_log_probs(made)
    adapted = torch_log_probs(random_adapter(made, tmp_path / "adapter", **changed))
    assert convert_adapter(tmp_path / "adapter", base, tmp_path / "lora.gguf") == 14
    assert np.abs(adapted - bare).max() > 0.5
    np.testing.assert_allclose(llama_log_probs(base, tmp_path / "lora.gguf"), adapted, atol=2e-4)
    np.testing.assert_allclose(llama_log_probs(base, tmp_path / "lora.gguf", scale=0.0), bare, atol=2e-4)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_read_exactly(dtype, tmp_path):
    random_adapter(model("llama"), tmp_path / "a", dtype)
    for module, pair in read_lora(tmp_path / "a").items():
        tensors = load_file(tmp_path / "a" / WEIGHTS_FILE)
        for half, found in (("A", pair.a), ("B", pair.b / 3.0)):
            there = tensors[f"base_model.model.{module}.lora_{half}.weight"].float().numpy()
            np.testing.assert_array_equal(found.astype(np.float32), there)


@given(heads=st.integers(1, 5), half=st.integers(1, 4), width=st.integers(1, 3))
def test_rows_are_permuted_head_by_head(heads, half, width):
    rows = np.arange(heads * 2 * half * width, dtype=np.float32).reshape(heads * 2 * half, width)
    np.testing.assert_array_equal(permute_rows(rows, heads), interleave_rows(rows, heads))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A base and an adapter that matches it."""
    folder = tmp_path_factory.mktemp("whole")
    made = model("llama")
    write_gguf(made, "llama", folder / "base.gguf")
    random_adapter(made, folder / "adapter")
    return folder


def changed(whole, tmp_path, config=None, tensors=None):
    folder = tmp_path / "adapter"
    shutil.copytree(whole / "adapter", folder)
    if config:
        path = folder / CONFIG_FILE
        path.write_text(json.dumps(json.loads(path.read_text()) | config))
    if tensors:
        save_file(tensors(load_file(folder / WEIGHTS_FILE)), folder / WEIGHTS_FILE)
    return folder


A = "base_model.model.model.layers.0.self_attn.q_proj.lora_A.weight"
B = A.replace("lora_A", "lora_B")


@pytest.mark.parametrize(
    "config",
    [
        {"use_dora": True},
        {"bias": "all"},
        {"lora_bias": True},
        {"modules_to_save": ["lm_head"]},
        {"trainable_token_indices": [1]},
        {"fan_in_fan_out": True},
        {"layer_replication": [[0, 1]]},
        {"peft_type": "VERA"},
        {"r": 8},
        {"target_parameters": ["x"]},
        {"r": None},
        {"r": True},
        {"lora_alpha": float("nan")},
        {"lora_alpha": float("inf")},
        {"lora_alpha": 1e39},
        {"lora_alpha": -1.0},
        {"lora_alpha": "16"},
        {"lora_alpha": None},
        {"rank_pattern": {"(": 2}},
        {"rank_pattern": [1]},
        {"alpha_pattern": {".*": "x"}},
        {"peft_type": "IA3"},
        {"layers_to_transform": [0]},
        {"layers_to_transform": 0},
        {"layers_pattern": "layers"},
        {"exclude_modules": ["q_proj"]},
        {"init_lora_weights": "pissa"},
        {"use_bdlora": {}, "kasa_config": {"x": 1}},
        {"unheard_of": 16},
    ],
    ids=str,
)
def test_everything_other_than_plain_lora_is_rejected(whole, tmp_path, config):
    with pytest.raises(ConfigurationError, match="LoRA"):
        convert_adapter(changed(whole, tmp_path, config), whole / "base.gguf", tmp_path / "out.gguf")
    assert not (tmp_path / "out.gguf").exists()


def test_every_setting_of_peft_is_either_known_or_rejected():
    """For the installed version of peft; its own defaults are plain LoRA."""
    fields = {one.name for one in dataclasses.fields(LoraConfig)}
    assert fields >= KNOWN_SETTINGS | set(PLAIN_VALUES)
    plain = LoraConfig(target_modules=["q_proj"]).to_dict()
    require_plain_lora(plain)
    for setting in fields - KNOWN_SETTINGS:
        with pytest.raises(ConfigurationError, match=setting):
            require_plain_lora(plain | {setting: "anything"})


@pytest.mark.parametrize("setting", ["rank_pattern", "alpha_pattern"])
@pytest.mark.parametrize("key", ["(([a-z._0-9])+)+!", ".*", "q_proj|k_proj", "q_pröj", "q_proj\n", "", "a^b"])
def test_a_pattern_that_is_not_a_name_is_rejected_and_never_evaluated(whole, tmp_path, setting, key):
    """The evaluation of the first one would take years."""
    folder = changed(whole, tmp_path, {setting: {key: 4}})
    with pytest.raises(ConfigurationError) as refused:
        read_lora(folder)
    assert refused.value.got == key


def test_a_pattern_may_anchor_a_layer_name_at_its_beginning(whole, tmp_path):
    folder = changed(whole, tmp_path, {"alpha_pattern": {"^model.layers.0.self_attn.q_proj": 24, "^q_proj": 96}})
    ours, before = read_lora(folder), read_lora(whole / "adapter")
    scaled = {name: np.abs(ours[name].b).max() / np.abs(before[name].b).max() for name in ours}
    assert scaled.pop("model.layers.0.self_attn.q_proj") == pytest.approx(2.0)
    assert set(scaled.values()) == {1.0}


def test_a_config_with_excessive_nesting_is_rejected(whole, tmp_path):
    folder = changed(whole, tmp_path)
    (folder / CONFIG_FILE).write_text("[" * 100_000)
    with pytest.raises(ConfigurationError, match=r"LoRA adapter_config\.json"):
        read_lora(folder)


@pytest.mark.parametrize(
    ("tensors", "word"),
    [
        (lambda t: {n: v for n, v in t.items() if n != B}, "only A"),
        (
            lambda t: (
                t
                | {
                    "base_model.model.lm_head.lora_A.weight": torch.zeros(4, 64),
                    "base_model.model.lm_head.lora_B.weight": torch.zeros(258, 4),
                }
            ),
            "lm_head",
        ),
        (lambda t: t | {"base_model.model.model.embed_tokens.lora_embedding_A": torch.zeros(4, 258)}, "embed"),
        (lambda t: t | {"base_model.model.model.layers.0.self_attn.q_proj.bias": torch.zeros(64)}, "bias"),
        (lambda t: t | {n.replace("layers.0", "layers.7"): t[n].clone() for n in (A, B)}, "layers.7"),
        (lambda t: t | {B: torch.zeros(32, 4)}, "another base"),
        (lambda t: t | {B: torch.full((64, 4), float("nan"))}, "finite"),
        (lambda t: t | {A: t[A].to(torch.int32)}, "F32, F16 or BF16"),
        (lambda t: {}, "at least one"),
    ],
    ids=["half a pair", "output", "embeddings", "bias", "no such layer", "shape", "no number", "integers", "empty"],
)
def test_a_tensor_that_does_not_match_the_base_is_rejected(whole, tmp_path, tensors, word):
    folder = changed(whole, tmp_path, tensors=lambda t: {n: v.contiguous() for n, v in tensors(t).items()})
    if word == "at least one":
        save_file({}, folder / WEIGHTS_FILE)
    with pytest.raises(ConfigurationError, match=word):
        convert_adapter(folder, whole / "base.gguf", tmp_path / "out.gguf")


def test_damaged_files_and_other_bases_are_rejected(whole, tmp_path):
    folder = changed(whole, tmp_path)
    (folder / WEIGHTS_FILE).write_bytes((folder / WEIGHTS_FILE).read_bytes()[:-9])
    with pytest.raises(ConfigurationError, match="safetensors"):
        convert_adapter(folder, whole / "base.gguf", tmp_path / "out.gguf")
    (folder / WEIGHTS_FILE).unlink()
    with pytest.raises(MissingDependencyError):
        convert_adapter(folder, whole / "base.gguf", tmp_path / "out.gguf")
    (tmp_path / "junk.gguf").write_bytes(b"GGUF" + os.urandom(64))
    with pytest.raises(ConfigurationError):
        convert_adapter(whole / "adapter", tmp_path / "junk.gguf", tmp_path / "out.gguf")
    with pytest.raises(ConfigurationError, match="architecture"):
        convert_adapter(whole / "adapter", _write_other_architecture(tmp_path / "gpt2.gguf"), tmp_path / "out.gguf")


def _write_other_architecture(path):
    writer = gguf.GGUFWriter(path, "gpt2")
    writer.add_block_count(2)
    writer.add_tensor("token_embd.weight", np.zeros((2, 2), np.float32))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return path


def test_a_full_disk_leaves_the_former_file(whole, tmp_path):
    out = tmp_path / "lora.gguf"
    out.write_bytes(b"before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(FileWriteError):
            convert_adapter(whole / "adapter", whole / "base.gguf", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert out.read_bytes() == b"before"
    assert [path.name for path in tmp_path.iterdir()] == ["lora.gguf"]
