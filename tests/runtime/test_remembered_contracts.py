"""Contracts that are executed in remembered scenes: only with the ledger of the samples."""

import pytest

from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.errors import ConfigurationError
from dualbrain.runtime.inspection.memory_replay import make_replay_evaluator
from tests.adaptation.sample_episodes import REGISTRY, distinct_episodes, episode, write_ledger


def test_a_sample_of_another_ledger_is_refused_before_any_execution(tmp_path):
    (tmp_path / "other").mkdir()
    with (
        write_ledger(tmp_path, distinct_episodes(4)) as ours,
        write_ledger(tmp_path / "other", [episode("foreign-1")]) as theirs,
    ):
        samples = curate(ours, REGISTRY, CurationConfig(held_out=0.0)).train
        foreign = curate(theirs, REGISTRY, CurationConfig(held_out=0.0)).train
        assert callable(make_replay_evaluator(ours, samples, seed=0))
        with pytest.raises(ConfigurationError, match=r"The memory foreign-1 .*--no-fly"):
            make_replay_evaluator(ours, (*samples, *foreign), seed=0)
