"""One cycle of exploration: stages, their order, and continuation after an interruption at any point."""

from contextlib import nullcontext

import msgspec
import pytest

from dualbrain.adaptation.config import AdaptConfig, FitConfig
from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.adaptation.value_model.value_model import load_value_model
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.runtime.data_collection import rollouts
from dualbrain.runtime.data_collection.exploration import cycle, explore
from dualbrain.runtime.data_collection.exploration.cycle import (
    SETTINGS_FILE,
    VALUE_MODEL_FILE,
    CycleConfig,
    build_cycle_dataset,
    collect_clean,
    execute_choices,
    explore_places,
    require_same_settings,
)
from dualbrain.runtime.data_collection.exploration.proposals import SOURCE
from dualbrain.runtime.data_collection.exploration.rehearsal import SOURCE as REHEARSED
from dualbrain.runtime.data_collection.exploration.training_set import TrainingSetConfig
from dualbrain.runtime.data_collection.exploration.trial import Trial
from tests.adaptation.sample_episodes import episode, summary, write_ledger

EPSILON = 0.0021
CONFIG = CycleConfig(
    explored=2,
    executed_seeds=(11, 12),
    executions=3,
    held_out=4,
    training_set=TrainingSetConfig(wordings=2, exemplars=0.0),
    adapt=AdaptConfig(curation=CurationConfig(rules=CleanRules(epsilon=EPSILON))),
)
INTERVENED_TURN = 1
"""The turn of each sequence whose Δ is above ε."""


class Interrupted(BaseException):
    """An interruption as by a kill."""


@pytest.fixture
def executed(monkeypatch):
    """Nothing is simulated: `slow` is best everywhere. Returns the list of executed proposals."""

    def siblings(place, names):
        about = place.placement
        return tuple(
            Trial(
                scene=place.scene_name,
                object_name=about.object_name,
                destination=about.destination,
                summary=about.summary,
                alternative=name,
                contract=place.contracts()[name],
                world="twin",
                kind="succeeded" if name == "slow" else "failed",
                Delta=0.0,
                duration=10.0,
            )
            for name in names
        )

    done = []

    def execute(one, ledger, turn, *, cache):
        done.append(one)
        record = episode(
            rollouts.memory_id_of_turn(turn),
            Delta=0.1 if turn == INTERVENED_TURN else 0.0,
            proposer=one.source,
            scene_summary=summary(number=turn),
            instruction=f"instruction {turn}",
        )
        write_ledger(ledger.parent, [record]).close()
        return record

    monkeypatch.setattr(explore, "execute_siblings", siblings)
    monkeypatch.setattr(rollouts, "run_proposal", execute)
    monkeypatch.setattr(rollouts, "EPISODES_PER_STEP", 2)
    return done


def run_cycle(folder):
    execute_choices(CONFIG, folder, explore_places(CONFIG, folder), cache=folder)
    return build_cycle_dataset(CONFIG, folder)


def test_a_cycle_executes_the_choices_and_admits_only_clean_ones(tmp_path, executed):
    data = run_cycle(tmp_path)
    assert len(executed) == 2 * CONFIG.executions
    assert all('"speed":0.1,' in one.contract for one in executed), "the best alternative is `slow`"
    n_clean = 2 * (CONFIG.executions - 1)
    assert data.card.sources[SOURCE] >= n_clean * CONFIG.training_set.wordings
    assert data.card.sources[REHEARSED] > 0
    assert data.card.memories == n_clean
    assert f"11/{rollouts.memory_id_of_turn(INTERVENED_TURN)}" not in {one.memory for one in data.train}
    assert {one.memory.partition("/")[0] for one in data.train if one.memory} == {"11", "12"}
    assert data.card.held_out == CONFIG.held_out
    assert data.card.scene_values
    assert not {one.scene for one in data.train} & {one.scene for one in data.held_out}


def test_progress_counts_all_sequences(tmp_path, executed):
    counts, places = [], []
    model = explore_places(CONFIG, tmp_path, lambda done, trials: places.append(done))
    execute_choices(CONFIG, tmp_path, model, cache=tmp_path, on_episode=lambda done, one: counts.append(done))
    assert counts == list(range(1, 2 * CONFIG.executions + 1))
    assert places == [1, 2]


def test_a_stored_value_model_is_used_again(tmp_path, executed, monkeypatch):
    first = explore_places(CONFIG, tmp_path)
    monkeypatch.setattr(cycle, "explore", lambda *args, **options: pytest.fail("explored again"))
    assert explore_places(CONFIG, tmp_path) == first == load_value_model(tmp_path / VALUE_MODEL_FILE)


@pytest.mark.parametrize("stop", [0, pytest.param(3, marks=pytest.mark.slow), 5])
def test_after_an_interruption_the_data_set_is_the_same(tmp_path, executed, monkeypatch, stop):
    whole = run_cycle(tmp_path / "whole")
    executed.clear()
    complete = rollouts.run_proposal

    def interrupted(one, ledger, turn, *, cache):
        if len(executed) == stop:
            executed.append(one)
            raise Interrupted
        return complete(one, ledger, turn, cache=cache)

    monkeypatch.setattr(rollouts, "run_proposal", interrupted)
    with pytest.raises(Interrupted):
        run_cycle(tmp_path / "again")
    monkeypatch.setattr(rollouts, "run_proposal", complete)
    assert run_cycle(tmp_path / "again") == whole


def test_a_cycle_without_executions_has_no_data_set(tmp_path, executed):
    model = explore_places(CONFIG, tmp_path)
    with pytest.raises(MissingDependencyError, match="sequence 11"):
        collect_clean(CONFIG, tmp_path, model)


def test_an_outcome_that_nothing_confirmed_is_no_training_data(tmp_path, executed, monkeypatch):
    """A success without independent confirmation stays a candidate of the memory, and curation excludes it."""
    complete = rollouts.run_proposal

    def unconfirmed(one, ledger, turn, *, cache):
        if turn != 0:
            return complete(one, ledger, turn, cache=cache)
        record = episode(
            rollouts.memory_id_of_turn(turn),
            proposer=one.source,
            scene_summary=summary(number=turn),
            instruction=f"instruction {turn}",
            second_opinion="none",
        )
        write_ledger(ledger.parent, [record]).close()
        return record

    monkeypatch.setattr(rollouts, "run_proposal", unconfirmed)
    data = run_cycle(tmp_path)
    assert f"11/{rollouts.memory_id_of_turn(0)}" not in {one.memory for one in data.train}


def test_a_folder_belongs_to_one_set_of_settings(tmp_path):
    require_same_settings(CONFIG, tmp_path)
    require_same_settings(CONFIG, tmp_path)
    other_training = AdaptConfig(curation=CONFIG.adapt.curation, fit=FitConfig(steps=5))
    require_same_settings(msgspec.structs.replace(CONFIG, adapt=other_training), tmp_path)
    with pytest.raises(ConfigurationError, match="explored 2, now 3"):
        require_same_settings(msgspec.structs.replace(CONFIG, explored=3), tmp_path)
    with pytest.raises(ConfigurationError, match="wordings"):
        require_same_settings(msgspec.structs.replace(CONFIG, training_set=TrainingSetConfig()), tmp_path)
    stored = msgspec.json.decode((tmp_path / SETTINGS_FILE).read_bytes())
    for part, refused in (("teach", ""), ("test", "part")):  # an earlier version stored the part of the split
        stored["training_set"]["part"] = part
        (tmp_path / SETTINGS_FILE).write_bytes(msgspec.json.encode(stored))
        with pytest.raises(ConfigurationError, match=refused) if refused else nullcontext():
            require_same_settings(CONFIG, tmp_path)
    (tmp_path / SETTINGS_FILE).write_bytes(b"{")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        require_same_settings(CONFIG, tmp_path)
