"""QLoRA: every frozen layer except the output matrix has four bits, and training on it has the same properties."""

import sys

import pytest

from dualbrain.errors import ConfigurationError, MissingDependencyError

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
lora = pytest.importorskip("peft.tuners.lora", reason="the extra `adapt` is not installed")

from dualbrain.adaptation.training.checkpoint import RunKey  # noqa: E402
from dualbrain.adaptation.training.model import quantized_layers  # noqa: E402
from dualbrain.adaptation.training.model.batching import collate, contract_hidden_states  # noqa: E402
from dualbrain.adaptation.training.model.lora_model import LoraModel  # noqa: E402
from dualbrain.adaptation.training.reference_states import compute_states, states_key  # noqa: E402
from tests.adaptation.tiny_model import model, random_samples, tokenizer  # noqa: E402
from tests.adaptation.training import tiny_training  # noqa: E402

NF4 = tiny_training.config_with(quantise="nf4")


def wide_model():
    return model(width=128, inner=192)


def packed_lora_model(config=NF4.fit, dtype=torch.float32):
    """A tiny model with LoRA in four bits, two blocks wide."""
    try:
        made = wide_model().to(dtype)
        quantized_layers.quantize_linear_layers(made, "cpu")
    except MissingDependencyError:
        pytest.skip("the extra `qlora` is not installed")
    return LoraModel(made, tokenizer(), config)


def test_without_the_package_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    with pytest.raises(MissingDependencyError, match=r"bitsandbytes of the extra `qlora` .*dualbrain\[qlora\]"):
        quantized_layers.quantize_linear_layers(model(), "cpu")


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_all_layers_except_the_output_matrix_are_packed_and_have_an_adapter(dtype):
    one, plain = packed_lora_model(dtype=dtype), LoraModel(wide_model(), tokenizer(), NF4.fit)
    assert set(one.parameters) == set(plain.parameters)
    assert {p.dtype for p in one.parameters.values()} == {one.head.dtype} == {dtype}
    assert {p.dtype for name, p in one.model.named_parameters() if "base_layer" in name} == {torch.uint8}
    adapted_layers = [layer for layer in one.model.modules() if hasattr(layer, "base_layer")]
    assert {type(layer) for layer in adapted_layers} == {lora.Linear4bit}
    assert torch.equal(one.head, plain.head.to(dtype))
    one.check_logits(random_samples(1)[0])


def test_rows_that_are_not_whole_blocks_are_rejected():
    packed_lora_model()
    with pytest.raises(ConfigurationError, match="row of the base in nf4: got 32, allowed: multiples of 64"):
        quantized_layers.quantize_linear_layers(model(), "cpu")


def test_each_packed_weight_is_close_to_the_original():
    """The widest gap between levels of NF4 is 0.304 of a block's largest weight: half of it, plus rounding."""
    one, plain = packed_lora_model(), dict(wide_model().named_modules())
    from bitsandbytes.functional import dequantize_4bit  # noqa: PLC0415

    for name, layer in one.base_model.named_modules():
        if name.endswith("proj"):
            weight = layer.base_layer.weight
            found, was = dequantize_4bit(weight.data, weight.quant_state), plain[name].weight
            largest = was.reshape(-1, 64).abs().amax(1, keepdim=True)
            assert 0.0 < float(((found - was).reshape(-1, 64).abs() / largest).max()) < 0.17


def test_gradients_pass_through_packed_layers_even_after_generation():
    """Against a finite difference along the gradient, whose slope is the squared norm."""
    one, some = packed_lora_model(), random_samples(3)
    one.generate_answers([some[0].prompt], 3)
    batch = collate(some, one.padding_id)

    def value():
        return contract_hidden_states(one.decoder, batch)[0][:, :9].mean()

    with torch.no_grad():
        for parameter in one.parameters.values():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(5)))
    value().backward()
    slope = sum(float(p.grad.square().sum()) for p in one.parameters.values())
    step = 1e-3 / slope**0.5
    ends = []
    for sign in (1.0, -2.0):
        with torch.no_grad():
            for parameter in one.parameters.values():
                parameter.add_(sign * step * parameter.grad)
            ends.append(float(value()))
    assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(slope, rel=0.02, abs=1e-9)


def test_training_on_packed_layers_learns_and_resumes_exactly(tmp_path, monkeypatch):
    """The divergence is relative to the packed base: 0 at the first step."""
    monkeypatch.setattr(tiny_training, "lora_model", packed_lora_model)
    progress_list = []
    whole = tiny_training.TinyTraining(tmp_path / "a", config=NF4)
    whole.run(progress_list.append)
    assert abs(progress_list[0].divergence) < 1e-6
    assert progress_list[-1].cross_entropy < progress_list[0].cross_entropy

    def stop(progress):
        if progress.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tiny_training.TinyTraining(tmp_path / "b", config=NF4).run(stop)
    tiny_training.TinyTraining(tmp_path / "b", config=NF4).run()
    assert tiny_training.TinyTraining(tmp_path / "b", config=NF4).output_files() == whole.output_files()


def test_training_without_packing_is_another_run_with_other_states(tmp_path, monkeypatch):
    one, some = packed_lora_model(), random_samples(3)
    plain = LoraModel(wide_model(), tokenizer(), tiny_training.DEFAULT_CONFIG.fit)
    assert states_key("base", some, one.number_format) != states_key("base", some, plain.number_format)
    runs = [
        (tiny_training.DEFAULT_CONFIG, plain.number_format),
        (tiny_training.DEFAULT_CONFIG, one.number_format),
        (NF4, plain.number_format),
    ]
    assert (
        len(
            {
                RunKey(data="a", base="base", number_format=numbers, objective=config.objective, fit=config.fit).digest
                for config, numbers in runs
            }
        )
        == 3
    )
    states = [compute_states(x.decoder, x.head, some, x.padding_id).hidden_states(some) for x in (one, plain)]
    assert not torch.allclose(*states, atol=1e-2)
    monkeypatch.setattr(tiny_training, "lora_model", lambda config: LoraModel(wide_model(), tokenizer(), config))
    tiny_training.TinyTraining(tmp_path / "fit").run()
    kept = (tmp_path / "fit" / tiny_training.STATES_FILE).read_bytes()
    monkeypatch.setattr(tiny_training, "lora_model", packed_lora_model)
    with pytest.raises(ConfigurationError, match="other data, settings or base"):
        tiny_training.TinyTraining(tmp_path / "fit", config=NF4)
    assert (tmp_path / "fit" / tiny_training.STATES_FILE).read_bytes() == kept
