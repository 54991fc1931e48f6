"""Contracts that are executed in remembered scenes: only with the ledger of the samples."""

import msgspec
import pytest

from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.errors import ConfigurationError
from dualbrain.runtime.inspection.memory_replay import make_replay_evaluator
from tests.adaptation.sample_episodes import REGISTRY, distinct_episodes, episode, scene, write_ledger


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


def test_a_memory_that_cannot_be_simulated_is_refused_before_any_execution(tmp_path):
    odd = episode("odd", perceived_scene=scene(other="table"))  # a second thing of this name
    with write_ledger(tmp_path, [*distinct_episodes(2), odd]) as ledger:
        first, *rest = curate(ledger, REGISTRY, CurationConfig(held_out=0.0)).train
        samples = (first, *rest, msgspec.structs.replace(first, memory="odd"))
        with pytest.raises(ConfigurationError, match=r"The world of memory odd cannot be simulated: .*--no-fly"):
            make_replay_evaluator(ledger, samples, seed=0)
