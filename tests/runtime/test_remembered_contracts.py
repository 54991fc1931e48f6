"""Contracts carried out where memories were made: only in the ledger that the questions are of."""

import pytest

from dualbrain.adaptation.curation.curate import Curation, curate
from dualbrain.errors import InvalidSetup
from dualbrain.runtime.memory_replay import remembered_flight
from tests.adaptation.sample_episodes import REGISTRY, episode, remember, several


def test_a_question_of_another_ledger_is_refused_before_anything_is_flown(tmp_path):
    (tmp_path / "other").mkdir()
    with remember(tmp_path, several(4)) as ours, remember(tmp_path / "other", [episode("strange")]) as theirs:
        asked = curate(ours, REGISTRY, Curation(held_out=0.0)).train
        strange = curate(theirs, REGISTRY, Curation(held_out=0.0)).train
        assert callable(remembered_flight(ours, asked, seed=0))
        with pytest.raises(InvalidSetup, match=r"'strange'.*--no-fly"):
            remembered_flight(ours, (*asked, *strange), seed=0)
