"""Order of samples, learning rate, early stopping, and compliance of answers, without torch."""

from collections import Counter
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.adaptation.compliance import compliant_share, make_gate_judge
from dualbrain.adaptation.config import FitConfig
from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.adaptation.early_stopping import EarlyStopping, HeldOutResult
from dualbrain.adaptation.training.schedule import learning_rate, plan_batches
from tests.adaptation.sample_episodes import REGISTRY, distinct_episodes, write_ledger


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 4), min_size=1, max_size=12), st.integers(1, 9), st.integers(1, 40), st.integers(0, 5))
def test_every_epoch_shows_each_sample_as_often_as_it_should(shown, batch, steps, seed):
    plan = plan_batches(shown, FitConfig(batch=batch, at_once=1, steps=steps, seed=seed))
    stream = [row for rows in plan for row in rows]
    assert [len(rows) for rows in plan] == [batch] * steps
    epoch = sum(shown)
    for start in range(0, len(stream) - epoch + 1, epoch):
        assert Counter(stream[start : start + epoch]) == Counter(dict(enumerate(shown)))
    longer = plan_batches(shown, FitConfig(batch=batch, at_once=1, steps=steps + 7, seed=seed))
    assert longer[:steps] == plan


def test_another_seed_is_another_order():
    one, other = (plan_batches([1] * 30, FitConfig(seed=seed)) for seed in (0, 1))
    assert one != other
    assert one == plan_batches([1] * 30, FitConfig(seed=0))


def test_the_rate_rises_then_falls_to_a_tenth():
    config = FitConfig(steps=100, warm_up=10, rate=1.0)
    rates = [learning_rate(step, config) for step in range(1, 101)]
    assert rates[0] == pytest.approx(0.1, rel=1e-3)
    assert max(rates) == rates[9] > 0.97
    assert all(a > b for a, b in pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(0.1)
    assert learning_rate(1, FitConfig(warm_up=0, rate=1.0)) > 0.99


def test_training_stops_without_improvement_and_compliance_comes_first():
    state = EarlyStopping()
    for compliance, loss, waited in (
        (0.2, 2.0, 0),
        (0.2, 1.99, 1),
        (0.2, 1.9, 0),
        (0.5, 5.0, 0),
        (0.4, 0.1, 1),
        (0.5, 4.99, 2),
        (0.5, 4.9, 0),
    ):
        state = state.updated(HeldOutResult(0, compliance, loss))
        assert state.waited == waited


def test_a_compliant_answer_is_accepted_by_the_gate_and_declines_nothing(tmp_path):
    with write_ledger(tmp_path, distinct_episodes(3)) as ledger:
        rows = curate(ledger, REGISTRY, CurationConfig(held_out=0.0)).train
    judge = make_gate_judge(REGISTRY)
    good = rows[0].contract
    context = {"robot": "panda", "registry": REGISTRY.hash}
    steps = [{"skill": "decline", "params": {"reason": "no"}}]
    declined = msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": steps}).decode()
    for text in (
        "",
        "{",
        good[:-1],
        good.replace("red_cube", "blue_cube"),
        good.replace("0.2", "9.2"),
        declined,
        "\ud800",
    ):
        assert not judge(text, rows[0])
    assert judge(good, rows[0])
    # `place` without a grasped object: only the rules of the robot would reject it.
    last = msgspec.json.decode(good)["action_sequence"][-1:]
    unheld = msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": last}).decode()
    assert judge(unheld, rows[0])
    assert compliant_share(judge, [good, "{", good], rows) == pytest.approx(2 / 3)
