"""dualbrain adapters: on its whole way from added to promoted to rolled back, by measurement only."""

import json
import os
import resource

import msgspec
import pytest

from dualbrain.adaptation.adapters.base_models import base_model_hash
from dualbrain.adaptation.adapters.card import (
    WEIGHTS_FILE,
    AdapterCard,
    hash_weights,
    read_adapter_card,
    write_adapter_card,
)
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.promotion import Measurement
from dualbrain.adaptation.adapters.registry import AdapterRegistry
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.serving.open_planner import shadow_log_path
from dualbrain.adaptation.serving.shadow import ShadowRecord
from dualbrain.cli.adapters.registry import MIN_SHADOW_ANSWERS
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.planner.protocol import STOP, TIMEOUT
from dualbrain.planner.registry import DEFAULT_PLANNER
from tests.adaptation.adapters.test_promotion import trial_results
from tests.adaptation.adapters.test_registry import strip_file_hashes


def put(home, words="weights", base="smollm2-135m-instruct", beside=""):
    """Add an adapter of these weights to the registry in `home`, and let it stand in the shadow of `beside`; its id."""
    source = home / f"source of {words}"
    source.mkdir()
    (source / WEIGHTS_FILE).write_bytes(words.encode())
    (source / "adapter_config.json").write_text("{}")
    card = AdapterCard(
        id=hash_weights(source),
        base=base,
        base_sha256=base_model_hash(base),
        robot="panda",
        registry="r",
        prompt="p",
        dataset="d" * 64,
        sources={base: 2},
        bootstrapped=False,
        precision="float32",
        steps=7,
        held_out=None,
        config=AdaptConfig(),
        versions={},
    )
    write_adapter_card(card, source)
    one = AdapterRegistry(home / "adapters").add(source, now=0.0).id
    stand_in_the_shadow(home, one, whole=MIN_SHADOW_ANSWERS, served=f"{base}+{beside[:16]}" if beside else base)
    return one


def stand_in_the_shadow(home, one, whole, broken=0, served="smollm2-135m-instruct"):
    """Write down what `one` said in the shadow: so many whole answers, and so many that did not come to their end."""
    log = shadow_log_path(home / "adapters", one)
    log.parent.mkdir(exist_ok=True)
    ends = [STOP] * whole + [TIMEOUT] * broken
    said = [
        ShadowRecord(
            served=served,
            candidate=one,
            instruction="words",
            served_text="its answer",
            candidate_text="my answer",
            finish=finish,
            seconds=1.0,
        )
        for finish in ends
    ]
    log.write_bytes(b"".join(msgspec.json.encode(glance) + b"\n" for glance in said))


@pytest.fixture
def name(tmp_path):
    """An adapter in the registry of this home, by its id."""
    return put(tmp_path)


@pytest.fixture
def sings(monkeypatch):
    """Canaries of adapters that are no adapters: what is wrong with their answers."""
    faults = {}
    monkeypatch.setattr("dualbrain.cli.adapters.registry.canary_error", lambda registry, one: faults.get(one, ""))
    monkeypatch.setattr("dualbrain.cli.adapters.registry.serving_runtime", lambda registry, one: "llama")
    return faults


def test_on_its_whole_way(run_command, name, tmp_path, sings):
    measured = tmp_path / "measured.json"
    measured.write_bytes(msgspec.json.encode(Measurement(trial_results(name, 21), trial_results("", 20))))
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "measured.json")
    assert code == ExitCode.FAILED_SAFELY
    assert "nothing is better beyond chance" in err
    measured.write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    sings[name] = "it answers as if no adapter were worn"
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "measured.json")
    assert (code, "as if no adapter" in err) == (ExitCode.FAILED_SAFELY, True)
    assert json.loads(run_command("adapters", "list", "--json")[1])["serving"] == []
    del sings[name]
    assert run_command("adapters", "promote", name[:8], "--measured", "measured.json")[0] == ExitCode.SUCCESS
    assert json.loads(run_command("adapters", "list", "--json")[1])["serving"] == [name]
    code, _, err = run_command("adapters", "rollback", "--reason", "a test")
    assert code == ExitCode.SUCCESS
    assert "the bare base serves again" in err
    kinds = [entry["kind"] for entry in json.loads(run_command("adapters", "history", "--json")[1])["journal"]]
    assert kinds == ["added", "promoted", "rolled back"]
    assert run_command("adapters", "rollback", "--reason", "a test")[0] == ExitCode.SETUP


def test_it_is_shown_verified_and_exported(run_command, name, tmp_path):
    assert name[:16] in run_command("adapters", "list")[1]
    assert json.loads(run_command("adapters", "show", name[:8])[1])["card"]["id"] == name
    assert run_command("adapters", "export", name[:8], "out")[0] == ExitCode.SUCCESS
    assert (tmp_path / "out" / WEIGHTS_FILE).read_bytes() == b"weights"
    assert run_command("adapters", "verify")[0] == ExitCode.SUCCESS
    (tmp_path / "adapters" / name / WEIGHTS_FILE).write_bytes(b"others")
    code, out, _ = run_command("adapters", "verify")
    assert code == ExitCode.FAILED_SAFELY
    assert "were changed" in out
    assert run_command("adapters", "export", name[:8], "out2")[0] == ExitCode.SETUP
    assert not (tmp_path / "out2").exists()


def test_what_is_exported_is_there_whole_or_not_at_all_and_others_may_read_it(run_command, name, tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3, limits[1]))
    try:
        code, _, err = run_command("adapters", "export", name[:8], "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (code, "not written" in err, list(tmp_path.glob("*out*"))) == (ExitCode.SETUP, True, [])
    before = os.umask(0o022)
    try:
        assert run_command("adapters", "export", name[:8], "deep/out")[0] == ExitCode.SUCCESS
    finally:
        os.umask(before)
    out = tmp_path / "deep" / "out"
    assert [path.stat().st_mode & 0o777 for path in (out, *out.iterdir())] == [0o755, 0o644, 0o644, 0o644]


@pytest.mark.parametrize("prefix", ["", "adapter:"])
def test_every_command_knows_an_adapter_by_all_of_its_names(run_command, name, tmp_path, sings, prefix):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", prefix + name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    left = tmp_path / "source of weights"
    packaged = read_adapter_card(packaged_folder("base-135m")).id
    names = {name[:8]: name, "champion": name, str(left): name, "base-135m": packaged}
    for number, (short, one) in enumerate(names.items()):
        code, out, err = run_command("adapters", "show", prefix + short)
        assert (code, json.loads(out)["card"]["id"]) == (ExitCode.SUCCESS, one), err
        assert run_command("adapters", "export", prefix + short, f"out{number}")[0] == ExitCode.SUCCESS
        assert hash_weights(tmp_path / f"out{number}") == one
    assert (
        run_command("adapters", "diff", prefix + "base-135m", f"{prefix}starter-135m", "--json")[0] == ExitCode.SUCCESS
    )
    for words in (("show", prefix + "champion"), ("export", prefix + "champion", "none"), ("diff", "champion", name)):
        code, _, err = run_command("adapters", *words, "--robot", "ur5e")
        assert (code, "champion of ur5e: got 'none'" in err) == (ExitCode.SETUP, True)
    code, _, err = run_command("adapters", "show", prefix + "nobody")
    assert (code, "base-135m, champion" in err) == (ExitCode.SETUP, True)


@pytest.fixture
def measurable(monkeypatch):
    """A measurement is let in as far as to who serves."""
    monkeypatch.setattr("dualbrain.adaptation.curation.dataset.read_dataset", lambda folder: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.compatibility.require_same_prompt", lambda card: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.compatibility.require_compatible", lambda *told: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.stacking.locate", lambda *told: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.stacking.read_lora", lambda *told: ())


@pytest.mark.parametrize("measured", [True, False])
def test_a_damaged_champion_is_told_with_the_way_out(run_command, name, tmp_path, sings, measurable, measured):
    another = put(tmp_path, "more weights")
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    (tmp_path / "adapters" / name / WEIGHTS_FILE).write_bytes(b"others")
    measure = ("adapters", "measure", another, "--data", "data", "--out", "o.json")
    code, _, err = run_command(*(measure if measured else ("plan", "go", "--planner", "adapter:champion")))
    assert (code, f"champion {name[:16]}" in err, "dualbrain adapters rollback" in err) == (ExitCode.SETUP, True, True)


@pytest.mark.parametrize("named", [True, False])
def test_who_serves_is_no_candidate(run_command, name, tmp_path, sings, measurable, named):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    who = name[:8] if named else "champion"
    code, _, err = run_command("adapters", "measure", who, "--data", "data", "--out", "o.json")
    assert (code, "candidate: got 'the champion itself'" in err) == (ExitCode.SETUP, True)


def test_what_no_hash_was_recorded_of_is_told_and_what_was_changed_is_not_exported(run_command, name, tmp_path):
    assert "recorded" not in run_command("adapters", "verify")[1]
    (tmp_path / "adapters" / name / "adapter_config.json").write_text('{"lora_alpha": 64}')
    code, out, _ = run_command("adapters", "verify")
    assert (code, "adapter_config.json of adapter" in out) == (ExitCode.FAILED_SAFELY, True)
    assert run_command("adapters", "export", name[:8], "out")[0] == ExitCode.SETUP
    strip_file_hashes(AdapterRegistry(tmp_path / "adapters"), name)
    code, out, _ = run_command("adapters", "verify")
    assert (code, "whole; config and card were not recorded" in out) == (ExitCode.SUCCESS, True)
    assert run_command("adapters", "export", name[:8], "out")[0] == ExitCode.SUCCESS


def test_one_damaged_adapter_hides_no_other(run_command, name, tmp_path, sings):
    second = put(tmp_path, "more weights", beside=name)
    for one, before in ((name, ""), (second, name)):
        (tmp_path / "m.json").write_bytes(
            msgspec.json.encode(Measurement(trial_results(one, 58), trial_results(before, 20)))
        )
        assert run_command("adapters", "promote", one[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    (tmp_path / "adapters" / name / WEIGHTS_FILE).write_bytes(b"others")
    told = json.loads(run_command("adapters", "list", "--json")[1])
    assert ([card["id"] for card in told["adapters"]], told["serving"]) == ([second], [second])
    assert "were changed" in told["damaged"][name]
    assert second[:16] in run_command("adapters", "list")[1]
    code, out, _ = run_command("adapters", "show", name[:8])
    assert (code, [e["kind"] for e in json.loads(out)["journal"]]) == (ExitCode.FAILED_SAFELY, ["added", "promoted"])
    assert run_command("adapters", "verify")[1].count("whole") == 1
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SETUP
    code, _, err = run_command("adapters", "rollback", "--reason", "a test")
    assert (code, "the bare base serves again" in err) == (ExitCode.SUCCESS, True)  # the former one is damaged


@pytest.mark.parametrize("base", ["smollm2-135m-instruct", "base-135m"])
@pytest.mark.parametrize("named", [True, False])
def test_each_base_is_rolled_back_by_its_name_or_as_that_which_serves(run_command, tmp_path, sings, base, named):
    one = put(tmp_path, base=base)
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(one, 58), trial_results("", 20))))
    run_command("adapters", "promote", one[:8], "--measured", "m.json")
    code, _, err = run_command("adapters", "rollback", "--reason", "a test", *(("--base", base) if named else ()))
    assert (code, "the bare base serves again" in err) == (ExitCode.SUCCESS, True)
    assert json.loads(run_command("adapters", "list", "--json")[1])["serving"] == []


def last(home):
    """The newest entry of the journal."""
    return AdapterRegistry(home / "adapters").entries()[-1]


def test_nothing_is_promoted_that_has_not_stood_in_the_shadow_unless_that_is_waived(run_command, name, tmp_path, sings):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    stand_in_the_shadow(tmp_path, name, whole=MIN_SHADOW_ANSWERS - 1, broken=5)
    sings[name] = "it is not asked its canaries before"
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
    assert (code, f"{MIN_SHADOW_ANSWERS - 1} of {MIN_SHADOW_ANSWERS} whole answers in the shadow" in err) == (
        ExitCode.FAILED_SAFELY,
        True,
    )
    assert f"shadow:{name[:16]}" in err
    assert last(tmp_path).kind == "added"
    for served in ("smollm2-135m-instruct+" + name[:16], "another"):  # its own shadow, or that of nobody who serves
        stand_in_the_shadow(tmp_path, name, whole=99, served=served)
        assert (
            f"0 of {MIN_SHADOW_ANSWERS} whole answers"
            in run_command("adapters", "promote", name[:8], "--measured", "m.json")[2]
        )
    stand_in_the_shadow(tmp_path, name, whole=MIN_SHADOW_ANSWERS - 1, broken=5, served="smollm2-135m-instruct in torch")
    del sings[name]
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", "-1")[0] == ExitCode.USAGE
    assert (
        run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", MIN_SHADOW_ANSWERS - 1)[0]
        == ExitCode.SUCCESS
    )
    assert last(tmp_path).reason == f"{MIN_SHADOW_ANSWERS - 1} answers in the shadow"
    run_command("adapters", "rollback", "--reason", "a test")
    shadow_log_path(tmp_path / "adapters", name).unlink()
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", 0)[0] == ExitCode.SUCCESS
    assert last(tmp_path).reason == "the shadow was waived, with 0 answers in it"
    assert "the shadow was waived" in run_command("adapters", "history")[1]


WHOEVER = (DEFAULT_PLANNER, f"{DEFAULT_PLANNER} in torch", "smollm2-135m-instruct", "base-135m", "mine@localhost")


@pytest.mark.parametrize("served", WHOEVER)
def test_where_none_is_champion_the_shadow_of_whichever_planner_serves_counts(
    run_command, name, tmp_path, sings, served
):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    second = put(tmp_path, "more weights")
    for author in (f"smollm2-135m-instruct+{one[:16]}" for one in (second, name)):
        stand_in_the_shadow(tmp_path, name, whole=MIN_SHADOW_ANSWERS, served=author)
        code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
        told = " ".join(err.split())
        assert (code, f"shadow:{name[:16]}@{DEFAULT_PLANNER}`, or beside another planner" in told) == (1, True)
    stand_in_the_shadow(tmp_path, name, whole=MIN_SHADOW_ANSWERS, served=served)
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
    told = " ".join(err.split())
    assert code == ExitCode.SUCCESS
    assert f"adapter {name[:16]} on smollm2-135m-instruct is the champion of panda now" in told
    assert "`--planner adapter:champion`" in told
    (tmp_path / "m.json").write_bytes(
        msgspec.json.encode(Measurement(trial_results(second, 58), trial_results(name, 20)))
    )
    stand_in_the_shadow(tmp_path, second, whole=MIN_SHADOW_ANSWERS, served=served)
    code, _, err = run_command("adapters", "promote", second[:8], "--measured", "m.json")
    assert (code, f"0 of {MIN_SHADOW_ANSWERS} whole answers" in err, "@" in err) == (
        ExitCode.FAILED_SAFELY,
        True,
        False,
    )


def test_a_measurement_of_others_is_told_before_anything_is_asked(run_command, name, tmp_path, monkeypatch):
    (tmp_path / "m.json").write_bytes(
        msgspec.json.encode(Measurement(trial_results("another", 58), trial_results("", 20)))
    )
    for asked in ("heard", "canary_fault", "runtime_here"):
        monkeypatch.setattr(f"dualbrain.cli.adapters.registry.{asked}", lambda *told: pytest.fail("asked"))
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
    assert (code, "measured adapters: got 'another against" in err, "gain +" in err) == (ExitCode.SETUP, True, False)


@pytest.mark.parametrize("fault", ["", "canary 0 was answered otherwise"])
def test_a_rollback_asks_whoever_serves_again_and_says_what_it_finds(run_command, name, tmp_path, sings, fault):
    second = put(tmp_path, "more weights", beside=name)
    for one, before in ((name, ""), (second, name)):
        (tmp_path / "m.json").write_bytes(
            msgspec.json.encode(Measurement(trial_results(one, 58), trial_results(before, 20)))
        )
        run_command("adapters", "promote", one[:8], "--measured", "m.json")
    sings[name] = fault
    code, _, err = run_command("adapters", "rollback", "--reason", "a test")
    assert (last(tmp_path).kind, last(tmp_path).adapter) == ("rolled back", name)
    assert f"{name[:16]} serves again" in err
    assert code == (ExitCode.FAILED_SAFELY if fault else ExitCode.SUCCESS)
    assert (f"will propose nothing: {fault}" if fault else "canaries are answered as they were") in err
    assert (
        run_command("adapters", "rollback", "--reason", "a test")[0] == ExitCode.SUCCESS
    )  # the bare base has no canaries


def test_the_journal_names_the_data_set_of_the_measurement(run_command, name, tmp_path, sings):
    measured = Measurement(trial_results(name, 58), trial_results("", 20), "d" * 64)
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(measured))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    assert AdapterRegistry(tmp_path / "adapters").entries()[-1].decision.dataset == "d" * 64


def test_only_what_was_measured_in_the_runtime_that_serves_is_promoted(run_command, name, tmp_path, sings):
    elsewhere = Measurement(trial_results(name, 58, runtime="another"), trial_results("", 20, runtime="another"))
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(elsewhere))
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", 0)
    assert (code, "runtime of the measurement: got 'another', allowed: llama. Measure again" in err) == (5, True)
    assert last(tmp_path).kind == "added"


@pytest.mark.parametrize("kept", [True, False])
def test_who_serves_in_another_runtime_than_it_was_measured_in_is_named(
    run_command, name, tmp_path, sings, monkeypatch, kept
):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    assert last(tmp_path).decision.runtime == "llama"
    assert json.loads(run_command("adapters", "list", "--json")[1])["measured_elsewhere"] == {}
    if kept:
        monkeypatch.setattr("dualbrain.cli.adapters.registry.serving_runtime", lambda registry, one: "llama 2")
    else:
        journal = tmp_path / "adapters" / "journal.jsonl"
        journal.write_text(journal.read_text().replace(',"runtime":"llama"', ""))
    words = "was measured in " + ("llama: " if kept else "a runtime that was not recorded: ")
    code, out, _ = run_command("adapters", "verify")
    assert (code, words in out) == (ExitCode.SUCCESS, True)
    assert words in json.loads(run_command("adapters", "list", "--json")[1])["measured_elsewhere"][name]
    assert words in " ".join(run_command("adapters", "list")[2].split())


@pytest.mark.parametrize("base", [(), ("--base", "base-135m")])
def test_where_nothing_was_ever_added_there_is_nothing_to_roll_back(run_command, tmp_path, base):
    code, out, err = run_command("adapters", "rollback", "--reason", "a test", *base)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "allowed:" in err
    assert not (tmp_path / "adapters").exists()


@pytest.mark.parametrize("arguments", [("show", "abcd"), ("promote", "abcd", "--measured", "none.json")])
def test_what_is_not_there_is_told(run_command, arguments):
    code, out, err = run_command("adapters", *arguments)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "abcd" in err or "none.json" in err


def test_a_lost_journal_is_told(run_command, name, tmp_path):
    (tmp_path / "adapters" / "journal.jsonl").rename(tmp_path / "elsewhere")
    code, out, _ = run_command("adapters", "verify")
    assert (code, f"{name[:16]} its folder is here, but the journal does not" in out) == (ExitCode.FAILED_SAFELY, True)
    assert "config and card were not recorded" not in out
    assert name in json.loads(run_command("adapters", "list", "--json")[1])["damaged"]
    assert "its folder is here" in run_command("adapters", "list")[2]


def test_ids_are_listed_whole_in_a_narrow_terminal(run_command, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "24")
    assert name[:16] in run_command("adapters", "list")[1]


def test_a_base_that_is_none_is_told_with_those_that_are(run_command, name):
    for base in ("nope", "minilm-l6-v2-int8"):  # an encoder is no base either
        code, _, err = run_command("adapters", "rollback", "--reason", "a test", "--base", base)
        assert (code, f"'{base}' is not a base." in err) == (ExitCode.SETUP, True)
        assert (
            err.partition("Known: ")[2]
            == "base-135m, qwen2.5-coder-1.5b-instruct, smollm2-135m-instruct, starter-135m.\n"
        )


def test_an_empty_registry_is_no_error(run_command):
    for command in ("list", "verify"):
        code, out, err = run_command("adapters", command)
        assert (code, out, "dualbrain adapt" in " ".join(err.split())) == (ExitCode.SUCCESS, "", True)
    assert json.loads(run_command("adapters", "list", "--json")[1]) == {
        "adapters": [],
        "serving": [],
        "damaged": {},
        "measured_elsewhere": {},
    }
