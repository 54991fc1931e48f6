"""`dualbrain adapters make`: exploration, data set, training; resumed after an interruption at any point."""

import json
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters import base_models
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, read_adapter_card
from dualbrain.adaptation.curation.dataset import CARD_FILE, read_dataset, read_dataset_card
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.cli.adapters import adapt as fitting
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.runtime.data_collection import rollouts, starter_dataset, synthetic_scenes
from dualbrain.runtime.data_collection.exploration import explore
from dualbrain.runtime.data_collection.exploration.cycle import CycleConfig
from dualbrain.runtime.data_collection.exploration.proposals import SOURCE
from dualbrain.runtime.data_collection.exploration.training_set import TrainingSetConfig
from dualbrain.runtime.data_collection.exploration.trial import Trial
from dualbrain.runtime.data_collection.rollouts import memory_id_of_turn
from tests.adaptation.sample_episodes import distinct_episodes, episode, summary, write_ledger

CYCLE = CycleConfig(
    explored=1,
    executed_seeds=(5,),
    executions=3,
    held_out=2,
    training_set=TrainingSetConfig(wordings=1, exemplars=0.0),
    adapt=starter_dataset.CYCLE.adapt,
)
EXAMPLE = Sample(
    id="a",
    prompt=[],
    completion=[],
    weight=0.5,
    Delta=0.0,
    duration=0.0,
    repeats=1,
    scene="panda tall:1",
    memory="",
    events=(),
    source="templates",
    graspable=(),
    receptive=(),
)


class Interrupted(BaseException):
    """An interruption as by a kill."""


@pytest.fixture
def bench(monkeypatch):
    """Nothing is simulated or trained; `stop` is the episode, or "fit", that is interrupted."""
    state = SimpleNamespace(stop=None, executed=[], trained=[])

    def explored(place, names):
        about = place.placement
        scene = {"scene": place.scene_name, "object_name": about.object_name, "destination": about.destination}
        outcome = {"summary": about.summary, "world": "twin", "kind": "succeeded", "Delta": 0.0, "duration": 10.0}
        return tuple(Trial(alternative=name, contract=place.contracts()[name], **scene, **outcome) for name in names)

    def executed(one, ledger, turn, *, cache):
        if state.stop == turn:
            state.stop = None
            raise Interrupted
        state.executed.append(turn)
        options = {"proposer": one.source, "scene_summary": summary(number=turn), "instruction": f"task {turn}"}
        episode_record = episode(memory_id_of_turn(turn), **options)
        write_ledger(ledger.parent, [episode_record]).close()
        return episode_record

    def adapt(data, config, base, judge, folder, **others):
        if state.stop == "fit":
            state.stop = None
            raise Interrupted
        state.trained.append((data.card.hash, config, base))
        return SimpleNamespace(id="a" * 64)

    monkeypatch.setattr(explore, "execute_siblings", explored)
    monkeypatch.setattr(rollouts, "run_proposal", executed)
    monkeypatch.setattr(rollouts, "EPISODES_PER_STEP", 2)
    monkeypatch.setattr(starter_dataset, "CYCLE", CYCLE)
    monkeypatch.setattr(fitting, "import_trainer", lambda: SimpleNamespace(adapt=adapt))
    monkeypatch.setattr(base_models, "find_base_model", lambda name, cache: name)
    return state


def test_it_explores_executes_curates_and_trains(run_command, bench, tmp_path):
    code, out, err = run_command("adapters", "make", "starter-135m", "--out", tmp_path / "made")
    data = read_dataset(tmp_path / "made" / "dataset")
    assert (code, out) == (ExitCode.SUCCESS, "")
    assert bench.executed == list(range(CYCLE.executions))
    assert bench.trained == [(data.card.hash, CYCLE.adapt, starter_dataset.BASE_MODEL)]
    assert set(data.card.sources) == {SOURCE, "templates"}
    assert "place 1/1  " in err
    assert " succeed  0.0 min left" in err
    assert "episode 1/3  " in err
    assert "episode 3/3  succeeded  Δ 0.0010  0.0 min left" in err
    assert f"{data.card.train} samples to train on" in err


@pytest.mark.parametrize("stop", [0, 2, "fit"])
def test_after_an_interruption_anywhere_the_data_set_is_the_same(run_command, bench, tmp_path, stop):
    run_command("adapters", "make", "starter-135m", "--out", tmp_path / "whole")
    bench.stop = stop
    with pytest.raises(Interrupted):
        run_command("adapters", "make", "starter-135m", "--out", tmp_path / "again")
    bench.executed.clear()
    run_command("adapters", "make", "starter-135m", "--out", tmp_path / "again")
    assert bench.executed == ([] if stop == "fit" else list(range(stop, CYCLE.executions)))
    assert len({one[0] for one in bench.trained}) == 1


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "ledger" not in path.name}


def change_card(folder, **parts):
    """Change the card of the data set in `folder`."""
    path = folder / "dataset" / CARD_FILE
    path.write_bytes(msgspec.json.encode(msgspec.structs.replace(read_dataset_card(folder / "dataset"), **parts)))


def test_a_starter_is_not_trained_on_another_data_set(run_command, bench, tmp_path):
    run_command("adapters", "make", "starter-135m", "--out", "made")
    bench.trained.clear()
    change_card(tmp_path / "made", robot="ur5e")
    before = contents(tmp_path / "made")
    code, out, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, out, bench.trained) == (ExitCode.SETUP, "", [])
    assert "The data set in made is not the present data set of starter-135m: robot ur5e, now panda." in err
    assert "another --out" in err
    assert contents(tmp_path / "made") == before


def test_a_data_set_of_adapt_is_rejected(run_command, bench, tmp_path):
    """A data set without the executions of the cycle is not that of the starter."""
    write_ledger(tmp_path, distinct_episodes(8)).close()
    run_command("adapt", "--export", "made/dataset")
    change_card(tmp_path / "made", scene_values=True)
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, bench.executed, bench.trained) == (ExitCode.SETUP, [], [])
    assert "value_model.json" in err
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["dataset"]


def test_a_synthetic_data_set_is_used_again_only_if_it_is_the_present_one(run_command, bench, tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic_scenes, "generate_examples", lambda count, part: (EXAMPLE,) * count)
    for _ in range(2):
        assert run_command("adapters", "make", "base-135m", "--out", "made")[0] == ExitCode.SUCCESS
    assert len(bench.trained) == 2
    change_card(tmp_path / "made", also={})
    code, _, err = run_command("adapters", "make", "base-135m", "--out", "made")
    assert (code, len(bench.trained)) == (ExitCode.SETUP, 2)
    assert "also {}, now {" in err
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, len(bench.trained)) == (ExitCode.SETUP, 2)
    assert "is not the present data set of starter-135m" in err


@pytest.mark.slow
@pytest.mark.llm
def test_a_small_starter_is_made_without_substitutes(run_command, tmp_path, monkeypatch):
    """With simulation and training, in a minute or two: its card is bootstrapped, and its size is the real one."""
    fit = {"steps": 1, "batch": 2, "at_once": 2, "save_every": 1, "ask_at_most": 0, "threads": 1}
    settings = starter_dataset.AdaptConfig(fit=starter_dataset.FitConfig(**fit))
    monkeypatch.setattr(starter_dataset, "CYCLE", msgspec.structs.replace(CYCLE, adapt=settings))
    code, out, _ = run_command("adapters", "make", "starter-135m", "--out", tmp_path / "made", "--json")
    folder = tmp_path / "made" / "adapter"
    card = read_adapter_card(folder)
    assert code == ExitCode.SUCCESS
    assert json.loads(out)["id"] == card.id
    assert card.bootstrapped
    assert card.base == "smollm2-135m-instruct"
    assert (folder / WEIGHTS_FILE).stat().st_size <= 5_000_000
