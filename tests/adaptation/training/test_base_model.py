"""The base in torch equals the one in the GGUF, with its stacked adapters; it is dequantised once."""

import json
import resource
import shutil

import pytest

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

import gguf  # noqa: E402

from dualbrain.adaptation.adapters.base_models import BaseModel, find_base_model  # noqa: E402
from dualbrain.adaptation.adapters.card import hash_weights  # noqa: E402
from dualbrain.adaptation.training.model import dequantized_base  # noqa: E402
from dualbrain.adaptation.training.model.base_model import load_base_model  # noqa: E402
from dualbrain.adaptation.training.model.dequantized_base import STAMP_FILE, dequantize_base  # noqa: E402
from dualbrain.core.storage.atomic_files import FileWriteError  # noqa: E402
from dualbrain.core.weights import find_weight_file  # noqa: E402
from dualbrain.errors import ConfigurationError, MissingDependencyError, UnknownNameError  # noqa: E402
from tests.adaptation import tiny_adapter, tiny_gguf  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning", "ignore::DeprecationWarning")
IDS = torch.tensor([[5, 80, 33, 200, 7, 7, 121]])


@pytest.fixture(scope="module")
def patch():
    with pytest.MonkeyPatch.context() as one:
        yield one


@pytest.fixture(scope="module")
def made(tmp_path_factory, patch):
    """A cache that holds a tiny base, and the torch model that was written into it."""
    tiny_gguf.patch_tokenizer(patch)
    cache = tmp_path_factory.mktemp("made") / "cache"
    return cache, tiny_adapter.install_base(cache, patch)


def logits(model):
    with torch.no_grad():
        return model(input_ids=IDS).logits.float()


def test_a_dequantised_base_computes_the_same_as_its_source(made):
    cache, source = made
    base = find_base_model(tiny_adapter.BASE, cache)
    assert base.sha256 == find_weight_file(tiny_adapter.BASE).sha256
    model, tokenizer = load_base_model(base, cache, torch.float32)
    torch.testing.assert_close(logits(model), logits(source), rtol=1e-5, atol=1e-5)
    assert tokenizer.chat_template
    assert not any(parameter.requires_grad for parameter in model.parameters())


@pytest.fixture
def own_cache(made, tmp_path):
    """A separate cache with a tiny base converted for torch, the folder of the conversion, and the base."""
    shutil.copytree(made[0], tmp_path / "cache")
    shutil.rmtree(tmp_path / "cache" / "torch", ignore_errors=True)
    base = find_base_model(tiny_adapter.BASE, tmp_path / "cache")
    return tmp_path / "cache", dequantize_base(base, tmp_path / "cache"), base


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def flip_bit(folder):
    data = bytearray((folder / "model.safetensors").read_bytes())
    data[-7] ^= 1
    (folder / "model.safetensors").write_bytes(data)


def other_versions(folder):
    stamp = json.loads((folder / STAMP_FILE).read_text())
    (folder / STAMP_FILE).write_text(json.dumps(stamp | {"versions": dict.fromkeys(stamp["versions"], "0")}))


DAMAGES = {
    "a flipped bit": flip_bit,
    "no stamp, as in older versions": lambda folder: (folder / STAMP_FILE).unlink(),
    "a stamp that cannot be read": lambda folder: (folder / STAMP_FILE).write_text("{"),
    "other versions": other_versions,
    "a missing file": lambda folder: (folder / "tokenizer.json").unlink(),
    "an additional file": lambda folder: (folder / "adapter_config.json").write_text("{}"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_changed_conversion_is_made_again_once(own_cache, monkeypatch, damage):
    cache, folder, base = own_cache
    before = contents(folder)
    DAMAGES[damage](folder)
    dequantize_base(base, cache)
    assert contents(folder) == before
    monkeypatch.setattr(dequantized_base, "_convert", lambda base, folder: pytest.fail("made twice"))
    dequantize_base(base, cache)
    assert {path.name for path in folder.parent.iterdir()} == {folder.name, f".{folder.name}.lock"}


@pytest.mark.parametrize("n_bytes_left", [2000, 20_000])
def test_a_full_disk_is_reported_and_leaves_no_base(own_cache, n_bytes_left):
    """Also if safetensors detects it, whose error is not an OSError."""
    cache, folder, base = own_cache
    shutil.rmtree(folder)
    before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes_left, hard))
    try:
        with pytest.raises(FileWriteError, match="File too large"):
            dequantize_base(base, cache)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))
    assert {path.name for path in folder.parent.iterdir()} == {f".{folder.name}.lock"}
    assert dequantize_base(base, cache) == folder


def test_an_unreadable_file_is_not_reported_as_a_full_disk(tmp_path):
    (tmp_path / "x.gguf").write_bytes(b"no model")
    with pytest.raises(ConfigurationError, match=r"GGUF of the base: .*x\.gguf"):
        dequantize_base(BaseModel(name="x", gguf=tmp_path / "x.gguf", gguf_sha256="1" * 64), tmp_path)


def test_a_base_with_missing_weights_is_rejected(own_cache, monkeypatch, tmp_path):
    missing, add_tensor = "blk.1.ffn_up.weight", gguf.GGUFWriter.add_tensor

    def add(writer, name, *args, **kwargs):
        if name != missing:
            add_tensor(writer, name, *args, **kwargs)

    monkeypatch.setattr(gguf.GGUFWriter, "add_tensor", add)
    path = tiny_gguf.write_gguf(tiny_gguf.model("llama"), "llama", tmp_path / "lacking.gguf")
    with pytest.raises(ConfigurationError, match=r"no model\.layers\.1\.mlp\.up_proj\.weight"):
        dequantize_base(BaseModel(name="x", gguf=path, gguf_sha256="1" * 64), tmp_path)
    assert not (tmp_path / "torch" / ("1" * 32)).exists()


def test_only_a_language_model_is_a_base(tmp_path):
    for name in ("minilm-l6-v2-int8", "efficientnet-lite0", "unknown"):
        with pytest.raises(UnknownNameError, match=r"not a base.*base-135m"):
            find_base_model(name, tmp_path)


def test_a_base_is_dequantised_once(made):
    cache, _ = made
    base = find_base_model(tiny_adapter.BASE, cache)
    first, _ = load_base_model(base, cache, torch.float32)
    gone = BaseModel(name=base.name, gguf=cache / "gone.gguf", gguf_sha256=base.gguf_sha256)
    again, _ = load_base_model(gone, cache, torch.float32)
    assert torch.equal(logits(first), logits(again))


def test_in_bf16_the_weights_are_rounded_and_the_rotary_frequencies_are_not(made):
    cache, source = made
    model, _ = load_base_model(find_base_model(tiny_adapter.BASE, cache), cache, torch.bfloat16)
    source_parameters = dict(source.named_parameters())
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter, source_parameters[name].to(torch.bfloat16)), name
    frequencies = [buffer for name, buffer in model.named_buffers() if "inv_freq" in name]
    assert frequencies
    assert all(buffer.dtype == torch.float32 for buffer in frequencies)


def test_stacked_adapters_are_merged_into_the_base(made, tmp_path):
    cache, source = made
    folder = tmp_path / "adapter"
    adapted, _ = tiny_adapter.write_adapter(source, folder)
    plain = find_base_model(tiny_adapter.BASE, cache)
    base = BaseModel(
        name="with adapter",
        gguf=plain.gguf,
        gguf_sha256=plain.gguf_sha256,
        stacked_on=(folder,),
        stacked_on_id=hash_weights(folder),
    )
    model, _ = load_base_model(base, cache, torch.float32)
    torch.testing.assert_close(logits(model), logits(adapted), rtol=1e-4, atol=1e-4)
    assert not torch.allclose(logits(model), logits(load_base_model(plain, cache, torch.float32)[0]), atol=1e-2)
    assert base.sha256 == hash_weights(folder)


def test_a_missing_base_is_reported(made):
    cache, _ = made
    with pytest.raises(UnknownNameError):
        find_base_model("unknown", cache)
    base = find_base_model(tiny_adapter.BASE, cache)
    with pytest.raises(MissingDependencyError, match=r"none\.gguf"):
        load_base_model(BaseModel(name="x", gguf=cache / "none.gguf", gguf_sha256="0" * 64), cache, torch.float32)
    assert not (cache / "torch" / ("0" * 32)).exists()
    assert base.gguf.is_file()
