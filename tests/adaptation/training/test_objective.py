"""The objective of the paper: against plain fine-tuning, by hand on three tokens, and in equivalent forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.adaptation.config import ObjectiveConfig
from dualbrain.adaptation.training.objective import normalize_weights, sample_weights

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from dualbrain.adaptation.training.master_weights import MasterWeights  # noqa: E402
from dualbrain.adaptation.training.model.batching import IGNORE_INDEX, collate, contract_hidden_states  # noqa: E402
from dualbrain.adaptation.training.model.precision import choose_dtype  # noqa: E402
from dualbrain.adaptation.training.objective import entropy, kl_divergence, objective, token_entropy_gate  # noqa: E402
from dualbrain.adaptation.training.reference_states import compute_states, load_states, save_states, states_key  # noqa: E402
from dualbrain.errors import ConfigurationError  # noqa: E402
from tests.adaptation.tiny_model import lora_model, perturbed, random_samples  # noqa: E402

P, P0 = (0.7, 0.2, 0.1), (0.1, 0.3, 0.6)


def partial_loss(one, samples, tokens, weights=None, **options):
    """The objective of `some` samples with the model `one`."""
    batch = collate(samples, one.padding_id)
    hidden, labels = contract_hidden_states(one.decoder, batch)
    sample_omega = torch.ones(len(samples)) if weights is None else torch.as_tensor(weights, dtype=torch.float32)
    token_omega = sample_omega.repeat_interleave(torch.tensor(batch.contract_token_counts))
    return objective(hidden, one.head, labels, token_omega, tokens, **options)


def reference_states(one, samples):
    with one.without_adapter():
        return compute_states(one.decoder, one.head, samples, one.padding_id)


def tokens_of(samples):
    return sum(len(sample.contract) for sample in samples)


def gradients(one):
    return {name: p.grad.clone() for name, p in one.parameters.items()}


def test_without_lambda_and_beta_it_is_plain_fine_tuning_step_for_step():
    """The oracle is the model's own loss over all logits with torch's own optimiser."""
    ours, theirs = lora_model(), lora_model()
    masters = MasterWeights(ours.parameters)
    plain = torch.optim.AdamW(theirs.parameters.values(), lr=1e-2, weight_decay=0.0)
    for step in range(5):
        some = random_samples(4, seed=step)
        loss = partial_loss(ours, some, tokens_of(some)).total
        loss.backward()
        masters.step(1e-2, clip=1e9)
        batch = collate(some, theirs.padding_id)
        labels = torch.full_like(batch.ids, IGNORE_INDEX)
        labels[:, 1:] = batch.targets[:, :-1]
        oracle = theirs.model(input_ids=batch.ids, attention_mask=batch.ids != theirs.padding_id, labels=labels).loss
        oracle.backward()
        plain.step()
        plain.zero_grad()
        assert float(loss.detach()) == pytest.approx(float(oracle.detach()), rel=1e-5)
    for name, parameter in ours.parameters.items():
        torch.testing.assert_close(parameter, theirs.parameters[name], rtol=1e-3, atol=1e-5)


def test_the_divergence_has_the_adapted_distribution_first_in_value_and_gradient():
    """Three tokens, p ≠ p₀ without symmetry: KL(p ‖ p₀) and its derivative p_k (log p_k/p₀_k − KL), both by hand."""
    expected = sum(p * math.log(p / q) for p, q in zip(P, P0, strict=True))
    backwards = sum(q * math.log(q / p) for p, q in zip(P, P0, strict=True))
    assert abs(expected - backwards) > 0.05
    logits = torch.tensor([P]).log().requires_grad_()
    found = kl_divergence(logits.log_softmax(-1), torch.tensor([P0]).log())
    found.sum().backward()
    by_hand = [p * (math.log(p / q) - expected) for p, q in zip(P, P0, strict=True)]
    assert float(found.detach()) == pytest.approx(expected, rel=1e-5)
    assert logits.grad[0].tolist() == pytest.approx(by_hand, abs=1e-6)


def test_the_objective_uses_the_divergence_with_the_adapted_model_first():
    """The same numbers through `objective`: with the identity as output matrix, hidden states are logits."""
    hidden, base = torch.tensor([P]).log(), torch.tensor([P0]).log()
    label, one = torch.tensor([0]), torch.ones(1)
    loss = objective(hidden, torch.eye(3), label, one, 1, beta=2.0, base_hidden=base)
    expected = sum(p * math.log(p / q) for p, q in zip(P, P0, strict=True))
    assert float(loss.total) == pytest.approx(-math.log(P[0]) + 2.0 * expected, rel=1e-5)


def test_a_fresh_adapter_has_no_divergence():
    one, some = lora_model(), random_samples(6)
    base = reference_states(one, some)
    loss = partial_loss(one, some, tokens_of(some), beta=1.0, base_hidden=base.hidden_states(some))
    assert float(loss.divergence) == pytest.approx(0.0, abs=1e-6)


def test_cached_and_online_divergence_are_the_same(tmp_path):
    """Also after saving and loading; a cache of other tokens or of another base is rejected."""
    one, some = perturbed(lora_model()), random_samples(7)
    kept, key = reference_states(one, some), states_key("base", some, "float32")
    save_states(kept, tmp_path / "states", key)
    read = load_states(tmp_path / "states", key)
    with torch.no_grad(), one.without_adapter():
        online, _ = contract_hidden_states(one.decoder, collate(some, one.padding_id))
    losses = [
        partial_loss(one, some, tokens_of(some), beta=0.5, base_hidden=base)
        for base in (online, kept.hidden_states(some), read.hidden_states(some))
    ]
    assert float(losses[0].divergence) > 0.01
    for loss in losses[1:]:
        assert float(loss.total.detach()) == pytest.approx(float(losses[0].total.detach()), rel=1e-5)
        assert float(loss.divergence) == pytest.approx(float(losses[0].divergence), rel=1e-4)
    assert read.entropies(some) == kept.entropies(some)
    assert load_states(tmp_path / "states", states_key("other", some, "float32")) is None
    assert load_states(tmp_path / "states", states_key("base", some[:-1], "float32")) is None
    (tmp_path / "states").write_bytes(b"no tensors")
    assert load_states(tmp_path / "states", key) is None


def test_one_batch_of_eight_equals_eight_batches_of_one():
    one, some = perturbed(lora_model()), random_samples(8)
    weights, base = np.linspace(0.5, 1.5, 8), reference_states(one, some)
    partial_loss(one, some, tokens_of(some), weights, beta=0.3, base_hidden=base.hidden_states(some)).total.backward()
    whole = gradients(one)
    for parameter in one.parameters.values():
        parameter.grad = None
    for sample, weight in zip(some, weights, strict=True):
        hidden = base.hidden_states([sample])
        partial_loss(one, [sample], tokens_of(some), [weight], beta=0.3, base_hidden=hidden).total.backward()
    for name, gradient in gradients(one).items():
        torch.testing.assert_close(gradient, whole[name], rtol=1e-3, atol=1e-6)


def test_the_objective_is_the_formula_of_the_paper():
    """Σ ω CE / Σ ω n + β Σ KL / Σ n over a whole data set, from all logits, in float64."""
    one, some = perturbed(lora_model()), random_samples(6)
    weights, tokens = np.array([1.0, 2.0, 1.5, 1.2, 1.9, 1.1]), [len(s.contract) for s in some]
    base, beta = reference_states(one, some), 0.4
    share = normalize_weights(weights, tokens, [1] * 6)
    loss = partial_loss(one, some, sum(tokens), share, beta=beta, base_hidden=base.hidden_states(some))
    weighted_loss = weight_sum = divergences = 0.0
    for sample, weight in zip(some, weights, strict=True):
        ids = torch.tensor([[*sample.prompt, *sample.contract]])
        with torch.no_grad():
            log_p = one.model(input_ids=ids).logits[0].double().log_softmax(-1)
            with one.without_adapter():
                log_q = one.model(input_ids=ids).logits[0].double().log_softmax(-1)
        for t, token in enumerate(sample.contract, start=len(sample.prompt) - 1):
            weighted_loss -= weight * float(log_p[t, token])
            weight_sum += weight
            divergences += float((log_p[t].exp() * (log_p[t] - log_q[t])).sum())
    expected = weighted_loss / weight_sum + beta * divergences / sum(tokens)
    assert float(loss.total.detach()) == pytest.approx(expected, rel=1e-4)


def test_the_token_gate_is_that_of_eaft_and_passes_no_gradient():
    sure, even = torch.tensor([[50.0, *[0.0] * 29]]), torch.zeros(1, 30)
    assert float(token_entropy_gate(sure.log_softmax(-1))) == pytest.approx(0.0, abs=1e-6)
    assert float(token_entropy_gate(even.log_softmax(-1))) == pytest.approx(1.0, rel=1e-6)
    assert not token_entropy_gate(even.requires_grad_().log_softmax(-1)).requires_grad
    hidden = torch.tensor([[2.0, 0.0, 1.0]])
    label, one = torch.tensor([1]), torch.ones(1)
    p = hidden.softmax(-1)[0].tolist()
    gate = -sum(x * math.log(x) for x in p) / math.log(3)
    loss = objective(hidden, torch.eye(3), label, one, 1, token_gate=True)
    assert float(loss.total) == pytest.approx(-gate * math.log(p[1]), rel=1e-5)


def test_entropy_is_over_the_whole_vocabulary():
    assert float(entropy(torch.zeros(1, 258).log_softmax(-1))) == pytest.approx(math.log(258), rel=1e-6)


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 9), st.integers(1, 90), st.integers(1, 4)), min_size=1))
def test_omega_is_at_least_one_and_increases_with_its_parts(rows):
    w, nats, tokens, shown = (list(column) for column in zip(*rows, strict=True))
    found = sample_weights(w, nats, ObjectiveConfig(lambda_w=0.5, lambda_h=0.7))
    assert np.all(found >= 1.0)
    assert np.all(found <= 2.2 + 1e-9)
    assert np.all(sample_weights(w, nats, ObjectiveConfig(lambda_w=0.0, lambda_h=0.0)) == 1.0)
    assert np.all(sample_weights(w, nats, ObjectiveConfig(lambda_w=0.0, entropy_gate="token")) == 1.0)
    by_entropy = sample_weights([0.5] * len(rows), nats, ObjectiveConfig())
    order = np.argsort(nats)
    assert np.all(np.diff(by_entropy[order]) >= 0.0)
    share = normalize_weights(found, tokens, shown)
    n = np.array(tokens) * np.array(shown)
    assert float((share * n).sum()) == pytest.approx(float(n.sum()))


def test_bf16_is_chosen_only_if_the_cpu_supports_it():
    assert choose_dtype("auto", {"amx_bf16": True}) is torch.bfloat16
    assert choose_dtype("auto", {"avx2": True}) is torch.float32
    assert choose_dtype("float32", {"amx_bf16": True}) is torch.float32
    with pytest.raises(ConfigurationError, match="bfloat16"):
        choose_dtype("bfloat16", {"avx2": True})


def test_small_steps_are_not_lost_in_bf16():
    """A thousand steps of 1e-4 change a bf16 parameter of size 1 by 0.1; without master weights it would not change."""
    parameter = torch.nn.Parameter(torch.ones(3, dtype=torch.bfloat16))
    masters = MasterWeights({"p": parameter})
    for _ in range(1000):
        parameter.grad = torch.ones_like(parameter)
        masters.step(1e-4, clip=1e9)
    assert parameter.detach().float().tolist() == pytest.approx([0.9] * 3, rel=0.01)


def test_a_gradient_that_is_not_finite_changes_nothing():
    parameter = torch.nn.Parameter(torch.ones(3))
    masters = MasterWeights({"p": parameter})
    parameter.grad = torch.tensor([1.0, float("nan"), 1.0])
    assert not math.isfinite(masters.step(0.1, clip=1.0))
    assert parameter.tolist() == [1.0] * 3
