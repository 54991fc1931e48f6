"""Samples computed together are what each is alone: padding on the right is seen by nothing that is read."""

import pytest

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from dualbrain.adaptation.training.model.batching import IGNORE_INDEX, Batch, collate, contract_hidden_states  # noqa: E402
from tests.adaptation.tiny_model import lora_model, perturbed, random_samples  # noqa: E402


@pytest.fixture(params=["sdpa", "eager"])
def one(request):
    """A moved adapter on a base that attends as the fit's does, and as plain matrices."""
    made = perturbed(lora_model())
    made.base_model.config._attn_implementation = request.param
    return made


def together(one, some):
    """The states of `some` in one batch, sample by sample."""
    batch = collate(some, one.padding)
    assert (batch.ids == one.padding).any()
    hidden, _ = contract_hidden_states(one.decoder, batch)
    return hidden.split(batch.contract_token_counts)


@torch.no_grad()
def test_the_states_of_a_batch_are_those_of_each_sample_alone(one):
    some = random_samples(8, longest=40)
    for sample, states in zip(some, together(one, some), strict=True):
        alone, _ = contract_hidden_states(one.decoder, collate([sample], one.padding))
        torch.testing.assert_close(states, alone, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_what_stands_in_the_padding_changes_no_bit(one):
    some = random_samples(8, longest=40)
    batch = collate(some, one.padding)
    other = Batch(torch.where(batch.ids == one.padding, 7, batch.ids), batch.targets)
    assert torch.equal(contract_hidden_states(one.decoder, batch)[0], contract_hidden_states(one.decoder, other)[0])


@torch.no_grad()
def test_padding_on_the_left_would_be_seen(one):
    """So the two laws above can fail: they are those of padding that lies behind."""
    short, long = sorted(random_samples(8, longest=40), key=lambda sample: len(sample.prompt) + len(sample.contract))[
        ::7
    ]
    batch = collate([short, long], one.padding)
    blank = int((batch.ids[0] == one.padding).sum())
    ids, targets = batch.ids.clone(), batch.targets.clone()
    ids[0], targets[0] = ids[0].roll(blank), targets[0].roll(blank)
    assert int((targets[0] != IGNORE_INDEX).sum()) == len(short.contract)
    found = contract_hidden_states(one.decoder, Batch(ids, targets))[0][: len(short.contract)]
    alone, _ = contract_hidden_states(one.decoder, collate([short], one.padding))
    assert float((found - alone).abs().max()) > 0.1


def test_gradients_of_a_batch_are_those_of_its_samples(one):
    some = random_samples(8, longest=40)
    sum(states.square().sum() for states in together(one, some)).backward()
    whole = {name: p.grad.clone() for name, p in one.parameters.items()}
    for parameter in one.parameters.values():
        parameter.grad = None
    for sample in some:
        contract_hidden_states(one.decoder, collate([sample], one.padding))[0].square().sum().backward()
    for name, parameter in one.parameters.items():
        torch.testing.assert_close(parameter.grad, whole[name], rtol=1e-3, atol=1e-3)
