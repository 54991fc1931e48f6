"""dualbrain adapters make starter-135m: a day of flights, a data set, a fit; stopped anywhere, it goes on there."""

import json
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters import base_models
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, read_adapter_card
from dualbrain.adaptation.curation import curate
from dualbrain.adaptation.curation.dataset import CARD_FILE, read_dataset, read_dataset_card
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.cli.adapters import adapt as fitting
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.runtime.data_collection import rollouts as room
from dualbrain.runtime.data_collection import starter_dataset, synthetic_scenes
from dualbrain.runtime.data_collection.rollouts import is_declined, memory_id_of_turn
from tests.adaptation.sample_episodes import distinct_episodes, episode, pick_contract, summary, write_ledger

DECLINE = pick_contract() | {"action_sequence": [{"skill": "decline", "params": {"reason": "no skill can do this"}}]}
NUMBER = 12
LESSON = Sample(
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


class Stopped(BaseException):
    """As if killed."""


@pytest.fixture
def stage(monkeypatch):
    """Nothing flies and nothing is fitted; `stop` names the turn, or "fit", at which all ends once."""
    here = SimpleNamespace(stop=None, flown=[], fitted=[])

    def carried_out(one, ledger, turn, *, cache):
        if here.stop == turn:
            here.stop = None
            raise Stopped
        here.flown.append(turn)
        same = {"by": one.source, "told": summary(number=turn), "words": f"errand {turn}"}
        facts = {"kind": "declined", "Delta": None, "duration": 0.0, "plan": DECLINE} if is_declined(one) else {}
        told = episode(memory_id_of_turn(turn), **facts, **same)
        write_ledger(ledger.parent, [told]).close()
        return told

    def adapt(data, config, base, judge, folder, **others):
        if here.stop == "fit":
            here.stop = None
            raise Stopped
        here.fitted.append((data.card.hash, config, base))
        return SimpleNamespace(id="a" * 64)

    monkeypatch.setattr(room, "run_proposal", carried_out)
    monkeypatch.setattr(room, "EPISODES_PER_STEP", 4)
    monkeypatch.setattr(starter_dataset, "N_PROPOSALS", NUMBER)
    monkeypatch.setattr(fitting, "import_trainer", lambda: SimpleNamespace(adapt=adapt))
    monkeypatch.setattr(base_models, "find_base_model", lambda name, cache: name)
    return here


def test_it_flies_chooses_and_fits_its_base_by_the_whole_objective(run_command, stage, tmp_path):
    code, out, err = run_command("adapters", "make", "starter-135m", "--out", tmp_path / "made")
    data = read_dataset(tmp_path / "made" / "dataset")
    assert (code, out) == (ExitCode.SUCCESS, "")
    assert stage.flown == list(range(NUMBER))
    assert stage.fitted == [(data.card.hash, starter_dataset.ADAPT_CONFIG, starter_dataset.BASE_MODEL)]
    assert set(data.card.sources) == {"templates"}
    assert f"flight 1/{NUMBER}  " in err
    assert f"flight {NUMBER}/{NUMBER}  succeeded  Δ 0.0010  0.0 min left" in err
    assert f"{data.card.train} samples to train on" in err


@pytest.mark.parametrize("stop", [0, 5, "fit"])
def test_stopped_anywhere_it_ends_with_the_same_data_set(run_command, stage, tmp_path, stop):
    run_command("adapters", "make", "starter-135m", "--out", tmp_path / "whole")
    stage.stop = stop
    with pytest.raises(Stopped):
        run_command("adapters", "make", "starter-135m", "--out", tmp_path / "again")
    stage.flown.clear()
    run_command("adapters", "make", "starter-135m", "--out", tmp_path / "again")
    assert stage.flown == ([] if stop == "fit" else list(range(stop - stop % 4, NUMBER)))
    assert len({one[0] for one in stage.fitted}) == 1


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "ledger" not in path.name}


def change(folder, **parts):
    """Change the card of the data set in `folder`."""
    path = folder / "dataset" / CARD_FILE
    path.write_bytes(msgspec.json.encode(msgspec.structs.replace(read_dataset_card(folder / "dataset"), **parts)))


ANOTHER = {
    "form": ({"form": "another"}, "form another, now conversational"),
    "robot": ({"robot": "ur5e"}, "robot ur5e, now panda"),
    "vocabulary": ({"registry": "00000000"}, "registry 00000000, now "),
    "prompt": ({"prompt": "0" * 16}, f"prompt {'0' * 16}, now "),
    "site": ({"site": "a" * 64}, f"site {'a' * 64}, now "),
    "further robots": ({"also": {"base": "00000000"}}, "also {'base': '00000000'}, now {}"),
    "number of proposals": ({"memories": 7}, f"memories 7, now {NUMBER}"),
    "dials": ({"epsilon": 0.003}, "epsilon 0.003, now 0.0021"),
    "ledger": ({"ledger": "f" * 64}, f"ledger {'f' * 16}, now that of "),
}


@pytest.mark.parametrize("part", ANOTHER)
def test_a_starter_is_not_fitted_on_another_data_set(run_command, stage, tmp_path, part):
    parts, words = ANOTHER[part]
    run_command("adapters", "make", "starter-135m", "--out", "made")
    stage.fitted.clear()
    change(tmp_path / "made", **parts)
    before = contents(tmp_path / "made")
    code, out, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, out, stage.fitted) == (ExitCode.SETUP, "", [])
    assert "data set in made: got " in err
    assert words in err
    assert "another --out" in err
    assert contents(tmp_path / "made") == before


def test_a_data_set_that_was_split_by_another_rule_is_another_one(run_command, stage, tmp_path, monkeypatch):
    run_command("adapters", "make", "starter-135m", "--out", "made")
    monkeypatch.setattr(curate, "is_held_out", lambda groups, share, salt: frozenset(groups[:1]))
    stage.fitted.clear()
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, stage.fitted) == (ExitCode.SETUP, [])
    assert f"samples {read_dataset_card(tmp_path / 'made' / 'dataset').hash[:16]} of the same ledger, now " in err


def test_what_adapt_left_is_no_starter(run_command, stage, tmp_path):
    """Also where the dials of both are the same: the day's ledger is not there."""
    write_ledger(tmp_path, distinct_episodes(8)).close()
    (tmp_path / "dials.toml").write_text(f"[curation.rules]\nepsilon = {starter_dataset.EPSILON}")
    run_command("adapt", "--export", "made/dataset", "--config", "dials.toml")
    change(tmp_path / "made", memories=NUMBER)
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, stage.flown, stage.fitted) == (ExitCode.SETUP, [], [])
    assert "now that of made/day" in err
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["dataset"]


def test_a_course_is_gone_on_with_only_as_it_is_taught_today(run_command, stage, tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic_scenes, "generate_examples", lambda count, part: (LESSON,) * count)
    for _ in range(2):
        assert run_command("adapters", "make", "base-135m", "--out", "made")[0] == ExitCode.SUCCESS
    assert len(stage.fitted) == 2
    change(tmp_path / "made", also={})
    code, _, err = run_command("adapters", "make", "base-135m", "--out", "made")
    assert (code, len(stage.fitted)) == (ExitCode.SETUP, 2)
    assert "also {}, now {" in err
    code, _, err = run_command("adapters", "make", "starter-135m", "--out", "made")
    assert (code, len(stage.fitted)) == (ExitCode.SETUP, 2)
    assert "what starter-135m is taught today" in err


@pytest.mark.slow
@pytest.mark.llm
def test_a_little_one_is_made_for_good(run_command, tmp_path, monkeypatch):
    """Flown and fitted, a minute or two: its card calls it bootstrapped, and it is as large as the real one."""
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
