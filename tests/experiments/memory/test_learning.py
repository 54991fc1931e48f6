"""Learning: means of thirds, rejections, and dynamic against static weights from the same start."""

import numpy as np
import pytest

from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.plasticity.hebbian_update import EPSILON
from experiments.figures.plot_learning import plot_learning
from experiments.memory.learning import compare_arms, mean_delta_of_thirds, median_success_delta, start_contracts


def row(arm, sizes, seed=0):
    episodes = [{"Delta": size, "decision_s": 1.0} for size in sizes]
    return {"scene": "a", "seed": seed, "arm": arm, "episodes": episodes, "ledger": "0" * 64, "parted": [[1, 0.5, 0.5]]}


def test_means_of_thirds_skip_episodes_without_motion():
    assert mean_delta_of_thirds(row("static", [0.4, None, 0.2, 0.1, 0.1, None, 0.0, 0.2, None])) == pytest.approx(
        (0.3, 0.1)
    )
    assert np.isnan(mean_delta_of_thirds(row("static", [0.4, None, None]))[1])


def test_arms_are_compared_per_ledger():
    first = [row("dynamic", [0.2, 0.1, 0.0]), row("static", [0.2, None, 0.1])]
    second = [row("dynamic", [0.2, 0.1, 0.3], 1), row("static", [0.2, 0.1, 0.1], 1)]
    third = [row("dynamic", [0.2, 0.1, 0.0], 2), row("static", [0.2, 0.1, 0.4], 2)]
    rows = [*first, *second, *third, row("dynamic", [0.0], 3)]
    text = " ".join(compare_arms(rows))
    assert "lower in 2 of 3 ledgers, higher in 1; mean difference -0.1000" in text
    assert "0 of 9 with dynamic weights, 1 of 9 with static ones" in text
    assert compare_arms(rows[-1:]) == []


def test_epsilon_is_the_default_if_the_start_has_no_success(tmp_path):
    Ledger(tmp_path / "ledger.sqlite", holder="test", now=0.0).close()
    assert median_success_delta(tmp_path / "ledger.sqlite") == EPSILON


def test_start_contracts_depend_only_on_the_seed():
    assert start_contracts(3) == start_contracts(3)
    assert start_contracts(3) != start_contracts(4)


def test_a_ledger_without_motion_is_plotted(tmp_path):
    plot_learning([row("dynamic", [None, 0.1]), row("static", [None, None])], tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 1000
