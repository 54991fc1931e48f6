"""`dualbrain adapters make starter-135m`: episodes, data set, training; resumed after an interruption at any point."""

import json
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters import base_models
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, read_adapter_card
from dualbrain.adaptation.curation import curate
from dualbrain.adaptation.curation.dataset import CARD_FILE, read_dataset, read_dataset_card
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.cli.adapters import training
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.runtime.data_collection import rollouts as room
from dualbrain.runtime.data_collection import starter_dataset, synthetic_scenes
from dualbrain.runtime.data_collection.rollouts import is_declined, memory_id_of_turn
from tests.adaptation.sample_episodes import distinct_episodes, episode, pick_contract, summary, write_ledger

DECLINE = pick_contract() | {"action_sequence": [{"skill": "decline", "params": {"reason": "no skill can do this"}}]}
N_EPISODES = 12
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
    """No episode is simulated and nothing is trained; `stop` is the episode, or "fit", that is interrupted."""
    state = SimpleNamespace(stop=None, executed=[], trained=[])

    def carried_out(one, ledger, turn, *, cache):
        if state.stop == turn:
            state.stop = None
            raise Interrupted
        state.executed.append(turn)
        options = {"proposer": one.source, "scene_summary": summary(number=turn), "instruction": f"task {turn}"}
        outcome = {"kind": "declined", "Delta": None, "duration": 0.0, "plan": DECLINE} if is_declined(one) else {}
        episode_record = episode(memory_id_of_turn(turn), **outcome, **options)
        write_ledger(ledger.parent, [episode_record]).close()
        return episode_record

    def adapt(data, config, base, judge, folder, **others):
        if state.stop == "fit":
            state.stop = None
            raise Interrupted
        state.trained.append((data.card.hash, config, base))
        return SimpleNamespace(id="a" * 64)

    monkeypatch.setattr(room, "run_proposal", carried_out)
    monkeypatch.setattr(room, "EPISODES_PER_STEP", 4)
    monkeypatch.setattr(starter_dataset, "N_PROPOSALS", N_EPISODES)
    monkeypatch.setattr(training, "import_trainer", lambda: SimpleNamespace(adapt=adapt))
    monkeypatch.setattr(base_models, "find_base_model", lambda name, cache: name)
    return state


def test_it_runs_episodes_curates_and_trains_with_the_complete_objective(run_command, bench, tmp_path):
    code, out, err = run_command("adapters", "make", "starter-135m", "--out", tmp_path / "made")
    data = read_dataset(tmp_path / "made" / "dataset")
    assert (code, out) == (ExitCode.SUCCESS, "")
    assert bench.executed == list(range(N_EPISODES))
    assert bench.trained == [(data.card.hash, starter_dataset.ADAPT_CONFIG, starter_dataset.BASE_MODEL)]
    assert set(data.card.sources) == {"templates"}
    assert f"episode 1/{N_EPISODES}  " in err
    assert f"episode {N_EPISODES}/{N_EPISODES}  succeeded  Δ 0.0010  0.0 min left" in err
    assert f"{data.card.train} samples to train on" in err


@pytest.mark.parametrize("stop", [0, 5, "fit"])
def test_after_an_interruption_anywhere_the_data_set_is_the_same(run_command, bench, tmp_path, stop):
    run_command("adapters", "make", "starter-135m", "--out", tmp_path / "whole")
    bench.stop = stop
    with pytest.raises(Interrupted):
        run_command("adapters", "make", "starter-135m", "--out", tmp_path / "again")
    bench.executed.clear()
    run_command("adapters", "make", "starter-135m", "--out", tmp_path / "again")
    assert bench.executed == ([] if stop == "fit" else list(range(stop - stop % 4, N_EPISODES)))
    assert len({one[0] for one in bench.trained}) == 1


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "ledger" not in path.name}


def change_card(folder, **parts):
    """Change the card of the data set in `folder`."""
    path = folder / "dataset" / CARD_FILE
    path.write_bytes(msgspec.json.encode(msgspec.structs.replace(read_dataset_card(folder / "dataset"), **parts)))


DIFFERENCES = {
    "form": ({"form": "another"}, "form another, now conversational"),
    "robot": ({"robot": "ur5e"}, "robot ur5e, now panda"),
    "vocabulary": ({"registry": "00000000"}, "registry 00000000, now "),
    "prompt": ({"prompt": "0" * 16}, f"prompt {'0' * 16}, now "),
    "site": ({"site": "a" * 64}, f"site {'a' * 64}, now "),
    "further robots": ({"also": {"base": "00000000"}}, "also {'base': '00000000'}, now {}"),
    "number of proposals": ({"memories": 7}, f"memories 7, now {N_EPISODES}"),
    "settings": ({"epsilon": 0.003}, "epsilon 0.003, now 0.0021"),
    "ledger": ({"ledger": "f" * 64}, f"ledger {'f' * 16}, now that of "),
}


@pytest.mark.parametrize("part", DIFFERENCES)
def test_a_starter_is_not_trained_on_another_data_set(run_command, bench, tmp_path, part):
    parts, words = DIFFERENCES[part]
    run_command("adapters", "make", "starter-135m", "--out", "made")
    bench.trained.clear()
    change_card(tmp_path / "made", **parts)
    before = contents(tmp_path / "made")
    code, out, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, out, bench.trained) == (ExitCode.SETUP, "", [])
    assert "The data set in made is not the present data set of starter-135m: " in err
    assert words in err
    assert "another --out" in err
    assert contents(tmp_path / "made") == before


def test_a_data_set_with_another_split_is_rejected(run_command, bench, tmp_path, monkeypatch):
    run_command("adapters", "make", "starter-135m", "--out", "made")
    monkeypatch.setattr(curate, "choose_held_out_groups", lambda groups, share, salt: frozenset(groups[:1]))
    bench.trained.clear()
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, bench.trained) == (ExitCode.SETUP, [])
    assert f"samples {read_dataset_card(tmp_path / 'made' / 'dataset').hash[:16]} of the same ledger, now " in err


def test_a_data_set_of_adapt_is_rejected(run_command, bench, tmp_path):
    """Also with the same settings: the ledger of the episodes is missing."""
    write_ledger(tmp_path, distinct_episodes(8)).close()
    (tmp_path / "settings.toml").write_text(f"[curation.rules]\nepsilon = {starter_dataset.EPSILON}")
    run_command("adapt", "--export", "made/dataset", "--config", "settings.toml")
    change_card(tmp_path / "made", memories=N_EPISODES)
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, bench.executed, bench.trained) == (ExitCode.SETUP, [], [])
    assert "now that of made/day" in err
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
    monkeypatch.setattr(starter_dataset, "N_PROPOSALS", 5)
    monkeypatch.setattr(
        starter_dataset, "ADAPT_CONFIG", starter_dataset.AdaptConfig(fit=starter_dataset.FitConfig(**fit))
    )
    code, out, _ = run_command("adapters", "make", "starter-135m", "--out", tmp_path / "made", "--json")
    folder = tmp_path / "made" / "adapter"
    card = read_adapter_card(folder)
    assert code == ExitCode.SUCCESS
    assert json.loads(out)["id"] == card.id
    assert card.bootstrapped
    assert card.base == "smollm2-135m-instruct"
    assert (folder / WEIGHTS_FILE).stat().st_size <= 5_000_000
