"""`dualbrain adapters explore`: settings from a file, refused robots, the registered adapter and the next commands."""

from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters import base_models
from dualbrain.adaptation.adapters.promotion import MIN_QUESTIONS
from dualbrain.cli.adapters import explore as command
from dualbrain.cli.adapters import registry, training
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.runtime.data_collection.exploration import cycle
from tests.adaptation.sample_episodes import pick_contract

SETTINGS = """
robot = "ur5e"
explored = 4
executed_seeds = [7, 8]
executions = 5
held_out = 3
[training_set]
wordings = 2
[adapt.fit]
steps = 30
"""


@pytest.fixture
def bench(monkeypatch):
    """Nothing is explored or trained; the settings that were used are recorded."""
    state = SimpleNamespace(settings=[], added=[])

    def write(name, config, folder):
        state.settings.append(config)
        return SimpleNamespace(card=SimpleNamespace(memories=0))

    card = SimpleNamespace(id="a" * 64, robot="ur5e", base="base-135m", base_sha256="c" * 64)
    monkeypatch.setattr(command, "write_explored_dataset", write)
    contract = msgspec.json.encode(pick_contract(robot="ur5e")).decode()
    held_out = [SimpleNamespace(id=f"q{k}", scene=f"s{k}", contract=contract) for k in range(MIN_QUESTIONS)]
    dataset = SimpleNamespace(held_out=held_out)
    monkeypatch.setattr("dualbrain.adaptation.curation.dataset.read_dataset", lambda folder: dataset)
    monkeypatch.setattr(training, "import_trainer", lambda: SimpleNamespace(adapt=lambda *args, **options: card))
    monkeypatch.setattr(base_models, "find_base_model", lambda name, cache: name)
    monkeypatch.setattr(
        registry,
        "open_adapter_registry",
        lambda: SimpleNamespace(add=lambda folder, now: state.added.append(folder), champion=lambda place: None),
    )
    return state


def test_the_settings_come_from_the_file(run_command, bench, tmp_path):
    (tmp_path / "cycle.toml").write_text(SETTINGS)
    code, _, err = run_command("adapters", "explore", "--config", tmp_path / "cycle.toml", "--out", tmp_path / "made")
    assert code == ExitCode.SUCCESS
    (used,) = bench.settings
    assert (used.robot, used.executed_seeds, used.executions) == ("ur5e", (7, 8), 5)
    assert (used.training_set.wordings, used.adapt.fit.steps) == (2, 30)
    assert bench.added == [tmp_path / "made" / "adapter"]
    assert "dualbrain adapters measure aaaaaaaaaaaaaaaa" in err
    assert "--planner shadow:aaaaaaaaaaaaaaaa@base-135m" in err, "beside the base that serves"
    assert "dualbrain adapters promote aaaaaaaaaaaaaaaa" in err


def test_the_robot_can_be_named(run_command, bench, tmp_path):
    run_command("adapters", "explore", "--robot", "ur5e", "--dataset-only", "--out", tmp_path / "made")
    assert bench.settings == [msgspec.structs.replace(cycle.CycleConfig(), robot="ur5e")]
    assert bench.added == []


def test_a_mobile_base_is_refused_before_anything_is_written(run_command, bench, tmp_path):
    code, _, err = run_command("adapters", "explore", "--robot", "base", "--out", tmp_path / "made")
    assert code == ExitCode.USAGE
    assert "mobile base" in err
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("executions = 0", "cycle executions"),
        ("executed_seeds = [3, 3]", "cycle executed_seeds"),
        ("steps = 3", "unknown field"),
        ("[training_set]\nsentences = 3", "unknown field"),
        ('[training_set]\npart = "test"', "unknown field"),
        ("[training_set]\nwordings = 0", "training set wordings"),
        ("[training_set]\nrehearsal = 1.0", "training set rehearsal"),
        ("[training_set]\nexemplars = -0.1", "training set exemplars"),
        ("[training_set]\ncorrupted = 1.5", "training set corrupted"),
        ("robot = ", "cannot be read"),
    ],
)
def test_wrong_settings_are_refused_with_their_name(run_command, bench, tmp_path, text, words):
    (tmp_path / "cycle.toml").write_text(text)
    code, _, err = run_command("adapters", "explore", "--config", tmp_path / "cycle.toml", "--out", tmp_path / "made")
    assert code == ExitCode.SETUP
    assert words in err
    assert bench.settings == []
