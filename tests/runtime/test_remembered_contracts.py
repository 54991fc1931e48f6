"""Contracts carried out where memories were made: only in the ledger that the questions are of."""

import pytest

from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.errors import ConfigurationError
from dualbrain.runtime.inspection.memory_replay import make_replay_evaluator
from tests.adaptation.sample_episodes import REGISTRY, distinct_episodes, episode, write_ledger


def test_a_question_of_another_ledger_is_refused_before_anything_is_flown(tmp_path):
    (tmp_path / "other").mkdir()
    with (
        write_ledger(tmp_path, distinct_episodes(4)) as ours,
        write_ledger(tmp_path / "other", [episode("strange")]) as theirs,
    ):
        asked = curate(ours, REGISTRY, CurationConfig(held_out=0.0)).train
        strange = curate(theirs, REGISTRY, CurationConfig(held_out=0.0)).train
        assert callable(make_replay_evaluator(ours, asked, seed=0))
        with pytest.raises(ConfigurationError, match=r"'strange'.*--no-fly"):
            make_replay_evaluator(ours, (*asked, *strange), seed=0)
