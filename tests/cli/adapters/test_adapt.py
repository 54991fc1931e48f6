"""`dualbrain adapt`: a dry run prints the selection and its reasons; other programs can read an export."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.curation.dataset import CARD_FILE, read_dataset, read_dataset_card
from dualbrain.adaptation.idle_scheduler import IdleSchedulerConfig, MachineLoad
from dualbrain.adaptation.training.process_group import SINGLE_PROCESS
from dualbrain.cli.adapters import adapt as command
from dualbrain.cli.adapters import adapt_when_idle, process_launcher, training
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.grounding.vocabulary import skill_registry_at_site
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.ledger.events import ADAPTER, AdapterUse
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.maintenance.compaction import compact_in_place
from dualbrain.memory.maintenance.edits import forget, quarantine, roll_back
from dualbrain.planner.registry import DEFAULT_PLANNER
from tests.adaptation.sample_episodes import CONFIG, NOW, distinct_episodes, episode, summary, write_ledger
from tests.support.process_state import process_state


@pytest.fixture
def ledger(tmp_path):
    failed = episode("bad", "failed", scene_summary=summary(number=99))
    write_ledger(tmp_path, [*distinct_episodes(8), failed]).close()
    return tmp_path / "ledger.sqlite"


def test_a_dry_run_prints_the_selection_and_changes_nothing(run_command, ledger, tmp_path):
    with LedgerReader(ledger) as opened:
        head = opened.head()
    before = {path.name for path in tmp_path.iterdir()}
    code, out, err = run_command("adapt", "--dry-run")
    assert (code, out) == (ExitCode.SUCCESS, "")
    assert "left out: 1 outcome failed" in err
    assert "of 9 memories" in err
    assert {path.name for path in tmp_path.iterdir()} == before
    with LedgerReader(ledger) as opened:
        assert opened.head() == head


def test_ids_of_a_dry_run_are_complete_in_a_narrow_terminal(run_command, ledger, monkeypatch):
    rows = json.loads(run_command("adapt", "--dry-run", "--json")[1])["samples"]
    monkeypatch.setenv("COLUMNS", "24")
    lines = run_command("adapt", "--dry-run")[2].splitlines()
    for row in rows:
        (line,) = (line for line in lines if line.startswith(row["id"][:8]))
        assert line.split()[1:3] == [row["part"], row["memory"]]
        assert f"{row['repeats']}×" in line


def test_a_dry_run_with_export_is_rejected(run_command, ledger, tmp_path):
    code, out, err = run_command("adapt", "--dry-run", "--export", "set")
    assert (code, out) == (ExitCode.USAGE, "")
    assert "a dry run writes nothing" in err
    assert not (tmp_path / "set").exists()


def test_with_a_site_file_the_episodes_at_the_site_are_selected(run_command, tmp_path):
    site = tmp_path / "lab.toml"
    site.write_text("[robot]\ntool_speed = 0.25\n")
    there = skill_registry_at_site("panda", site)
    write_ledger(
        tmp_path, [*distinct_episodes(2), episode("there", registry=there.hash, scene_summary=summary(number=9))]
    ).close()
    for options, left_out in (((), {"of another registry": ["there"]}), (("--site", "lab.toml"), {})):
        code, out, _ = run_command("adapt", "--dry-run", "--json", *options)
        assert (code, json.loads(out)["left_out"]) == (ExitCode.SUCCESS, left_out)
    assert "--site lab.toml" in " ".join(
        adapt_when_idle.adapt_command("panda", "b", None, site.relative_to(tmp_path), None, tmp_path, json=False)
    )


def test_json_names_every_memory_once(run_command, ledger):
    code, out, _ = run_command("adapt", "--dry-run", "--json")
    output = json.loads(out)
    names = [row["memory"] for row in output["samples"]] + [
        name for all_ in output["left_out"].values() for name in all_
    ]
    assert code == ExitCode.SUCCESS
    assert sorted(names) == sorted([*(f"e{i}" for i in range(8)), "bad"])
    assert {row["part"] for row in output["samples"]} == {"train", "held_out"}


def test_an_export_is_lines_of_prompt_and_completion(run_command, ledger, tmp_path):
    assert run_command("adapt", "--export", "set")[0] == ExitCode.SUCCESS
    lines = (tmp_path / "set" / "train.jsonl").read_text().splitlines()
    for line in map(json.loads, lines):
        assert line["prompt"][-1]["role"] == "user"
        assert [turn["role"] for turn in line["completion"]] == ["assistant"]
        json.loads(line["completion"][0]["content"])
    assert len(read_dataset(tmp_path / "set").train) == len(lines)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--ledger", "none.sqlite"), "none.sqlite"),
        (("--config", "none.toml"), "none.toml"),
        (("--robot", "unknown"), "unknown"),
        (("--robot", "ur5e"), "of another robot"),
    ],
)
def test_a_configuration_error_is_reported(run_command, ledger, arguments, word):
    code, out, err = run_command("adapt", "--dry-run", *arguments)
    assert (code, out) == (ExitCode.SETUP, "")
    assert word in err
    assert "Traceback" not in err


@pytest.mark.parametrize("options", [("--dry-run",), ("--export", "set"), ("--out", "fit"), (), ("--when-idle",)])
@pytest.mark.parametrize("base", ["nope", "minilm-l6-v2-int8"])
def test_an_unknown_base_is_reported_before_anything_is_written(run_command, ledger, tmp_path, options, base):
    before = contents(tmp_path)
    code, out, err = run_command("adapt", "--base", base, *options)
    assert (code, out) == (ExitCode.SETUP, "")
    assert f"'{base}' is not a base" in err
    assert contents(tmp_path) == before
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("options", [(), ("--out", "a fit [of] mine")])
def test_the_folder_is_printed_at_the_start_and_after_an_interrupt(run_command, ledger, tmp_path, monkeypatch, options):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "import_trainer", interrupted)
    code, _, err = run_command("adapt", *options)
    (data,) = tmp_path.rglob(CARD_FILE)
    folder = data.parent.parent.relative_to(tmp_path)
    assert code == ExitCode.INTERRUPTED
    assert f"all files are kept in {folder}\n" in err
    assert f"resume with the same command and --out {shlex.quote(str(folder))}\n" in err


@pytest.fixture
def trained(ledger, monkeypatch):
    """Nothing is trained or registered; the state names the champion."""
    state = SimpleNamespace(champion="")
    registry = SimpleNamespace(add=lambda folder, now: None, champion=lambda place: state.champion, verify=dict)
    monkeypatch.setattr("dualbrain.cli.adapters.registry.open_adapter_registry", lambda: registry)
    monkeypatch.setattr(command, "_record_in_ledger", lambda *args: True)
    facts = {"id": "a" * 64, "robot": "panda", "base": "base-135m", "base_sha256": "c" * 64}
    trainer = SimpleNamespace(adapt=lambda *args, **kwargs: SimpleNamespace(**facts))
    monkeypatch.setattr(training, "import_trainer", lambda: trainer)
    monkeypatch.setattr("dualbrain.adaptation.adapters.base_models.find_base_model", lambda name, cache: name)
    return state


def test_a_new_adapter_is_reported_with_the_questions_that_its_measurement_lacks(run_command, trained, tmp_path):
    code, _, err = run_command("adapt", "--out", "fit")
    count = len(read_dataset(tmp_path / "fit" / "dataset").held_out)
    message = " ".join(err.split())
    assert code == ExitCode.SUCCESS
    assert f"`dualbrain adapters measure` refuses its data set. held-out questions: got {count}, allowed: at" in message
    assert "dualbrain adapters promote" not in err


@pytest.mark.parametrize("ledger_named", [False, True])
@pytest.mark.parametrize("serves", [False, True])
def test_a_new_adapter_is_reported_with_the_next_commands(run_command, trained, monkeypatch, ledger_named, serves):
    for name in ("MIN_QUESTIONS", "MIN_SCENES"):
        monkeypatch.setattr(f"dualbrain.adaptation.serving.measurement.{name}", 1)
    trained.champion = "b" * 64 if serves else ""
    of, one = " --ledger ledger.sqlite" if ledger_named else "", "a" * 16
    code, _, err = run_command("adapt", "--out", "fit", *of.split())
    assert code == ExitCode.SUCCESS
    assert err.splitlines()[-3:] == [
        f"  dualbrain adapters measure {one} --data fit/dataset --out fit/measured.json{of}",
        f'  dualbrain run "…" --robot panda --planner shadow:{one}{"" if serves else f"@{DEFAULT_PLANNER}"}',
        f"  dualbrain adapters promote {one} --measured fit/measured.json",
    ]


def test_without_the_extra_the_error_names_it(run_command, ledger, monkeypatch, tmp_path):
    """Independent of the imports of other tests."""
    for name in [name for name in sys.modules if name.startswith("dualbrain.adaptation.training.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("dualbrain.adaptation.training.train", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    code, out, err = run_command("adapt", "--out", "fit")
    assert (code, out) == (ExitCode.SETUP, "")
    assert "The package torch of the extra `adapt` is missing" in err
    assert "dualbrain[adapt]" in err
    assert len(read_dataset(tmp_path / "fit" / "dataset").train)


def test_a_run_is_not_resumed_with_another_vocabulary(run_command, ledger, tmp_path):
    run_command("adapt", "--export", "fit/dataset")
    card = msgspec.structs.replace(read_dataset_card(tmp_path / "fit" / "dataset"), registry="00000000")
    (tmp_path / "fit" / "dataset" / CARD_FILE).write_bytes(msgspec.json.encode(card))
    code, _, err = run_command("adapt", "--out", "fit")
    assert code == ExitCode.SETUP
    assert "The vocabulary has changed" in err


def test_a_run_is_not_resumed_with_another_prompt(run_command, ledger, stop_before_training, tmp_path):
    """An adapter that is trained on prompts of a former version could neither be measured nor serve."""
    run_command("adapt", "--export", "fit/dataset")
    card = msgspec.structs.replace(read_dataset_card(tmp_path / "fit" / "dataset"), prompt="00000000")
    (tmp_path / "fit" / "dataset" / CARD_FILE).write_bytes(msgspec.json.encode(card))
    code, _, err = run_command("adapt", "--out", "fit")
    assert code == ExitCode.SETUP
    assert "has the prompt template 00000000, but the present one is" in " ".join(err.split())


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def stop_before_training(monkeypatch):
    """A run that is accepted ends where training would start."""

    def fail():
        raise MissingDependencyError("torch", fix="")

    monkeypatch.setattr(training, "import_trainer", fail)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("[curation.rules]\nepsilon = 0.002", "epsilon 0.003, now 0.002"),
        ("[curation.rules]\nslowest = 2.0", "slowest 1.5, now 2.0"),
        ("[curation.rules]\nphysical = false", "physical True, now False"),
        ("[curation]\nmost_repeats = 2", "most_repeats 4, now 2"),
        ("[curation]\nheld_out = 0.5", "held_out 0.2, now 0.5"),
        ('[curation]\nsalt = "x"', "salt dualbrain, now x"),
    ],
)
def test_other_settings_of_curation_are_rejected_for_an_existing_data_set(
    run_command, ledger, stop_before_training, tmp_path, settings, words
):
    run_command("adapt", "--out", "fit")
    before = contents(tmp_path / "fit")
    (tmp_path / "settings.toml").write_text(settings)
    code, _, err = run_command("adapt", "--out", "fit", "--config", "settings.toml")
    assert code == ExitCode.SETUP
    assert words in err
    assert "another --out" in err
    assert contents(tmp_path / "fit") == before


def test_another_ledger_is_rejected_for_an_existing_data_set(run_command, ledger, stop_before_training, tmp_path):
    run_command("adapt", "--out", "fit")
    before = contents(tmp_path / "fit")
    (tmp_path / "other").mkdir()
    write_ledger(tmp_path / "other", distinct_episodes(12)).close()
    code, _, err = run_command("adapt", "--out", "fit", "--ledger", "other/ledger.sqlite")
    assert code == ExitCode.SETUP
    assert "The data set in fit is of another ledger than other/ledger.sqlite" in err
    assert "another --out" in err
    assert contents(tmp_path / "fit") == before


def test_other_robots_of_a_shared_ledger_are_rejected_for_an_existing_data_set(
    run_command, ledger, stop_before_training, tmp_path, monkeypatch
):
    run_command("adapt", "--out", "fit")
    before = contents(tmp_path / "fit")
    monkeypatch.setattr(LedgerReader, "usable_writers", ("two", "one"))
    code, _, err = run_command("adapt", "--out", "fit")
    assert code == ExitCode.SETUP
    assert "was made from the memories of all robots; now those of one, two are to be used" in err
    assert "another --out" in err
    assert contents(tmp_path / "fit") == before
    monkeypatch.setattr(LedgerReader, "usable_writers", ())
    assert "using the data set in fit" in run_command("adapt", "--out", "fit")[2]


def test_another_site_is_rejected_for_an_existing_data_set(run_command, ledger, stop_before_training, tmp_path):
    (tmp_path / "lab.toml").write_text("[robot]\ntool_speed = 0.25\n")
    run_command("adapt", "--out", "here")
    run_command("adapt", "--out", "there", "--site", "lab.toml")
    there = ("--site", "lab.toml")
    for folder, same, other in (("here", (), there), ("there", there, ())):
        assert f"using the data set in {folder}" in run_command("adapt", "--out", folder, *same)[2]
        before = contents(tmp_path / folder)
        code, _, err = run_command("adapt", "--out", folder, *other)
        assert code == ExitCode.SETUP
        assert f"The data set in {folder} was made for " in err
        assert "another --out" in err
        assert contents(tmp_path / folder) == before


def test_a_ledger_that_has_grown_or_was_compacted_is_accepted(run_command, ledger, stop_before_training, tmp_path):
    run_command("adapt", "--out", "fit")
    before = contents(tmp_path / "fit")
    write_ledger(tmp_path, [episode("later", scene_summary=summary(number=55))]).close()
    assert "using the data set in fit" in run_command("adapt", "--out", "fit")[2]
    for _ in range(2):
        compact_in_place(ledger, holder="a test", now=NOW, timeout_s=1.0)
        assert "using the data set in fit" in run_command("adapt", "--out", "fit")[2]
    for archive in tmp_path.glob("*.archive-*"):
        archive.unlink()
    assert "The data set in fit is of another ledger" in run_command("adapt", "--out", "fit")[2]
    assert contents(tmp_path / "fit") == before


@pytest.mark.parametrize("edit", [quarantine, forget])
def test_a_data_set_with_a_memory_that_was_excluded_since_is_rejected(
    run_command, ledger, stop_before_training, tmp_path, edit
):
    run_command("adapt", "--out", "fit")
    before = contents(tmp_path / "fit")
    write_ledger(tmp_path, [], lambda memory: edit(memory, ["e1", "bad"], "poisoned", now=NOW)).close()
    code, _, err = run_command("adapt", "--out", "fit")
    assert code == ExitCode.SETUP
    assert "memories that were quarantined, forgotten or rolled back since: e1. Name another --out" in " ".join(
        err.split()
    )
    assert contents(tmp_path / "fit") == before
    (tmp_path / "fit" / "adapter").mkdir()
    (tmp_path / "fit" / "adapter" / "adapter.json").touch()  # complete: the same command only records it
    assert "using the data set in fit" in run_command("adapt", "--out", "fit")[2]


def test_a_data_set_with_a_memory_that_was_rolled_back_is_rejected(run_command, ledger, stop_before_training, tmp_path):
    with LedgerReader(ledger) as opened:
        before = opened.head().seq
    write_ledger(tmp_path, [episode("later", scene_summary=summary(number=55))]).close()
    run_command("adapt", "--out", "fit")
    write_ledger(tmp_path, [], lambda memory: roll_back(memory, before, "a test", now=NOW)).close()
    code, _, err = run_command("adapt", "--out", "fit")
    assert (code, "rolled back since: later." in " ".join(err.split())) == (ExitCode.SETUP, True)


def test_a_data_set_with_a_card_of_an_older_version_is_accepted(run_command, ledger, stop_before_training, tmp_path):
    """Such a card records neither whether outcomes were a criterion nor whose memories could be used."""
    run_command("adapt", "--out", "fit")
    path = tmp_path / "fit" / "dataset" / CARD_FILE
    card = json.loads(path.read_text())
    del card["physical"], card["use_memories_of"]
    path.write_text(json.dumps(card))
    assert "using the data set in fit" in run_command("adapt", "--out", "fit")[2]


def test_the_training_data_of_an_adapter_is_recorded_in_the_ledger(run_command, ledger, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("dualbrain.cli.memory.open_memory.load_encoder", lambda: HashingEncoder(32))
    monkeypatch.setattr("dualbrain.cli.memory.open_memory.memory_config", lambda opened: CONFIG)
    run_command("adapt", "--export", "set")
    dataset = read_dataset(tmp_path / "set")
    card = SimpleNamespace(id="a" * 64, dataset=dataset.card.hash)
    assert command._record_in_ledger(card, dataset, tmp_path / "fit", ledger)
    assert command._record_in_ledger(card, dataset, tmp_path / "fit", ledger)  # a second call adds nothing
    with LedgerReader(ledger) as opened:
        (event,) = opened.events(ADAPTER)
    recorded = msgspec.json.decode(event.payload, type=AdapterUse)
    assert recorded == AdapterUse("a" * 64, dataset.card.hash, tuple(sorted(row.memory for row in dataset.train)))
    assert not command._record_in_ledger(card, dataset, tmp_path / "fit", tmp_path / "none.sqlite")
    assert "not recorded in the ledger" in capsys.readouterr().err


def test_when_idle_runs_the_same_command_in_a_process_of_its_own(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(adapt_when_idle, "read_machine_load", lambda: MachineLoad(0.0, 2, on_battery=False))
    options = {"robot": "panda", "base": "smollm2-135m-instruct", "site": None, "config": None, "json": False}
    code = adapt_when_idle.adapt_when_idle(
        ledger=tmp_path / "none.sqlite",
        out=tmp_path / "out",
        pace=IdleSchedulerConfig(poll_period=0.05, quiet_time=0.0),
        **options,
    )
    assert code == ExitCode.SETUP
    assert "none.sqlite" in capfd.readouterr().err


def test_when_idle_waits_for_a_gatekeeper_at_a_socket_of_its_own(tmp_path, monkeypatch, capfd):
    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(adapt_when_idle, "read_machine_load", lambda: MachineLoad(0.0, 2, on_battery=False))
    monkeypatch.setattr(adapt_when_idle, "running_sockets", lambda home: [tmp_path / "robot.sock"])
    monkeypatch.setattr(adapt_when_idle.time, "sleep", interrupted)
    options = {"robot": "panda", "base": "tiny", "ledger": tmp_path / "l", "site": None, "config": None, "json": False}
    with pytest.raises(KeyboardInterrupt):
        adapt_when_idle.adapt_when_idle(out=tmp_path / "out", **options)
    assert "waiting: a gatekeeper at" in " ".join(capfd.readouterr().err.split())


@pytest.mark.parametrize(
    ("end", "words"), [("os.kill(os.getpid(), 9)", "signal 9 (Killed)"), ("sys.exit(1)", ""), ("sys.exit(0)", "")]
)
def test_when_idle_a_killed_training_is_reported_with_how_to_resume(tmp_path, monkeypatch, capfd, end, words):
    monkeypatch.setattr(adapt_when_idle, "read_machine_load", lambda: MachineLoad(0.0, 2, on_battery=False))
    work = [sys.executable, "-S", "-c", f"import os, sys; {end}"]
    monkeypatch.setattr(adapt_when_idle, "adapt_command", lambda *args, **kwargs: work)
    options = {"robot": "panda", "base": "tiny", "ledger": tmp_path / "l", "site": None, "config": None, "json": False}
    code = adapt_when_idle.adapt_when_idle(
        out=Path("runs/first"), pace=IdleSchedulerConfig(poll_period=0.05, quiet_time=0.0), **options
    )
    err = " ".join(capfd.readouterr().err.split())
    assert (code == ExitCode.SETUP) is bool(words)
    assert (words in err, "with --out runs/first resumes from the last checkpoint" in err) == (True, bool(words))


WATCHER = """
import sys
from pathlib import Path
from dualbrain.cli.adapters import adapt_when_idle
from dualbrain.adaptation.idle_scheduler import IdleSchedulerConfig, MachineLoad

folder = Path(sys.argv[1])
work = "import os, sys, time\\nopen(sys.argv[1] + '/pid', 'w').write(str(os.getpid()))\\ntime.sleep(600)"
adapt_when_idle.adapt_command = lambda *args, **kwargs: [sys.executable, "-S", "-c", work, str(folder)]
adapt_when_idle.read_machine_load = lambda: MachineLoad(0.0, 2, on_battery=(folder / "unplugged").exists())
arguments = {"robot": "panda", "base": "tiny", "ledger": folder / "l", "site": None, "config": None}
arguments |= {"out": folder, "json": False}
try:
    adapt_when_idle.adapt_when_idle(**arguments, pace=IdleSchedulerConfig(poll_period=0.05, quiet_time=0.0))
except KeyboardInterrupt:
    sys.exit(130)
"""
"""`adapt --when-idle` with a training that only sleeps; it is paused when a file called unplugged exists."""


def wait_until(holds):
    """Wait up to half a minute until the condition holds; returns whether it does."""
    until = time.monotonic() + 30.0
    while not holds() and time.monotonic() < until:
        time.sleep(0.02)
    return holds()


@pytest.mark.parametrize("paused", [False, True])
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_no_training_outlives_its_scheduler(tmp_path, end, paused):
    watcher, fit = subprocess.Popen([sys.executable, "-c", WATCHER, str(tmp_path)], start_new_session=True), 0
    try:
        assert wait_until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
        fit = int((tmp_path / "pid").read_text())
        if paused:
            (tmp_path / "unplugged").touch()
            assert wait_until(lambda: process_state(fit) == "T")
        watcher.send_signal(end)
        assert watcher.wait(30.0) == (-end if end == signal.SIGKILL else ExitCode.INTERRUPTED)
        assert wait_until(lambda: not process_state(fit))
    finally:
        watcher.kill()
        watcher.wait()
        if process_state(fit):
            os.kill(fit, signal.SIGKILL)


def test_several_processes_need_one_folder_and_can_only_train(run_command, ledger, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    for arguments in (("--out", "fit", "--dry-run"), ("--export", "set"), ("--out", "fit", "--when-idle")):
        code, out, err = run_command("adapt", *arguments)
        assert (code, out) == (ExitCode.SETUP, "")
        assert "Several processes cannot run adapt" in err
    for arguments in (("adapt",), ("adapters", "make", "base-135m")):
        code, out, err = run_command(*arguments)
        assert (code, out) == (ExitCode.SETUP, "")
        assert "Training in several processes needs --out" in err


def test_a_single_process_is_no_group_and_only_the_first_of_several_prints(capsys):
    assert not process_launcher.is_distributed({})
    assert not process_launcher.is_distributed({"WORLD_SIZE": "1"})
    assert process_launcher.is_distributed({"WORLD_SIZE": "2"})
    for size in ("", "two", "-2"):
        with pytest.raises(ConfigurationError, match="unset WORLD_SIZE"):
            process_launcher.is_distributed({"WORLD_SIZE": size})
    process_launcher.console_of(SINGLE_PROCESS).print("printed")
    process_launcher.console_of(SimpleNamespace(rank=1)).print("not printed")
    assert capsys.readouterr().err == "printed\n"
