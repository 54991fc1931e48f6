"""Batched samples give the same states as single ones: padding on the right has no effect."""

import pytest

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from dualbrain.adaptation.training.model.batching import IGNORE_INDEX, Batch, collate, contract_hidden_states  # noqa: E402
from tests.adaptation.tiny_model import lora_model, perturbed, random_samples  # noqa: E402


@pytest.fixture(params=["sdpa", "eager"])
def one(request):
    """A changed adapter on a base with the attention of training, and with eager attention."""
    made = perturbed(lora_model())
    made.base_model.config._attn_implementation = request.param
    return made


def batched_states(one, samples):
    """The states of `some` samples in one batch, sample by sample."""
    batch = collate(samples, one.padding_id)
    assert (batch.ids == one.padding_id).any()
    hidden, _ = contract_hidden_states(one.decoder, batch)
    return hidden.split(batch.contract_token_counts)


@torch.no_grad()
def test_the_states_of_a_batch_are_those_of_each_sample_alone(one):
    samples = random_samples(8, longest=40)
    for sample, states in zip(samples, batched_states(one, samples), strict=True):
        alone, _ = contract_hidden_states(one.decoder, collate([sample], one.padding_id))
        torch.testing.assert_close(states, alone, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_the_padding_tokens_change_no_bit(one):
    samples = random_samples(8, longest=40)
    batch = collate(samples, one.padding_id)
    other = Batch(torch.where(batch.ids == one.padding_id, 7, batch.ids), batch.targets)
    assert torch.equal(contract_hidden_states(one.decoder, batch)[0], contract_hidden_states(one.decoder, other)[0])


@torch.no_grad()
def test_padding_on_the_left_would_have_an_effect(one):
    """So the two properties above are not trivial: they hold for padding on the right."""
    short, long = sorted(random_samples(8, longest=40), key=lambda sample: len(sample.prompt) + len(sample.contract))[
        ::7
    ]
    batch = collate([short, long], one.padding_id)
    blank = int((batch.ids[0] == one.padding_id).sum())
    ids, targets = batch.ids.clone(), batch.targets.clone()
    ids[0], targets[0] = ids[0].roll(blank), targets[0].roll(blank)
    assert int((targets[0] != IGNORE_INDEX).sum()) == len(short.contract)
    found = contract_hidden_states(one.decoder, Batch(ids, targets))[0][: len(short.contract)]
    alone, _ = contract_hidden_states(one.decoder, collate([short], one.padding_id))
    assert float((found - alone).abs().max()) > 0.1


def test_gradients_of_a_batch_are_those_of_its_samples(one):
    samples = random_samples(8, longest=40)
    sum(states.square().sum() for states in batched_states(one, samples)).backward()
    whole = {name: p.grad.clone() for name, p in one.parameters.items()}
    for parameter in one.parameters.values():
        parameter.grad = None
    for sample in samples:
        contract_hidden_states(one.decoder, collate([sample], one.padding_id))[0].square().sum().backward()
    for name, parameter in one.parameters.items():
        torch.testing.assert_close(parameter.grad, whole[name], rtol=1e-3, atol=1e-3)
