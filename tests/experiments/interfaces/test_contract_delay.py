"""The experiment on the delay by contracts runs each of its variants."""

import pytest

from experiments.interfaces import contract_delay
from experiments.interfaces.contract_delay import VARIANTS, ContractDelay


@pytest.mark.parametrize("variant", VARIANTS)
def test_each_variant_leaves_a_row_that_is_reported(variant, monkeypatch):
    monkeypatch.setattr(contract_delay, "N_TICKS", 200)
    experiment = ContractDelay()
    row = experiment.run({"variant": variant, "seed": 0})
    assert (row["contracts"] > 0) == (variant != "no contracts")
    assert len(row["intervals"]) == len(row["cpu"]) == 3
    assert variant in "\n".join(experiment.report([row]))
