"""`dualbrain adapters`: an adapter is added, measured, promoted and rolled back."""

import json
import os
import resource
import zlib

import msgspec
import numpy as np
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
from dualbrain.adaptation.adapters.registry import ADAPTER_FILES, AdapterRegistry
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.conversion.concatenated_lora import write_peft_adapter
from dualbrain.adaptation.conversion.peft_lora import LoraPair
from dualbrain.adaptation.serving.open_planner import shadow_log_path
from dualbrain.adaptation.serving.shadow import ShadowRecord
from dualbrain.cli.adapters.registry import MIN_SHADOW_ANSWERS
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.planner.protocol import STOP, TIMEOUT
from dualbrain.planner.registry import DEFAULT_PLANNER
from tests.adaptation.adapters.test_promotion import trial_results
from tests.adaptation.adapters.test_registry import strip_file_hashes


def add_adapter(home, content="weights", base="smollm2-135m-instruct", beside=""):
    """Add an adapter with the weights `content` and shadow answers beside `beside` to the registry; returns its id."""
    source = home / f"source of {content}"
    number = float(zlib.crc32(content.encode()))
    pair = LoraPair(np.full((1, 2), number, np.float32), np.ones((2, 1), np.float32))
    write_peft_adapter({"model.layers.0.self_attn.q_proj": pair}, source, base=base)
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
    write_shadow_log(home, one, n_complete=MIN_SHADOW_ANSWERS, served=f"{base}+{beside[:16]}" if beside else base)
    return one


def write_shadow_log(home, one, n_complete, n_incomplete=0, served="smollm2-135m-instruct"):
    """Log the shadow answers of `one`: `whole` complete ones and `broken` incomplete ones."""
    log = shadow_log_path(home / "adapters", one)
    log.parent.mkdir(exist_ok=True)
    finish_reasons = [STOP] * n_complete + [TIMEOUT] * n_incomplete
    records = [
        ShadowRecord(
            served=served,
            candidate=one,
            instruction="words",
            served_text="its answer",
            candidate_text="my answer",
            finish=finish,
            seconds=1.0,
        )
        for finish in finish_reasons
    ]
    log.write_bytes(b"".join(msgspec.json.encode(record) + b"\n" for record in records))


@pytest.fixture
def name(tmp_path):
    """The id of an adapter in the registry of this home."""
    return add_adapter(tmp_path)


@pytest.fixture
def canary_faults(monkeypatch):
    """Faults of canary answers by id, in place of checks that need real adapters."""
    faults = {}
    monkeypatch.setattr("dualbrain.cli.adapters.registry.canary_error", lambda registry, one: faults.get(one, ""))
    monkeypatch.setattr("dualbrain.cli.adapters.registry.serving_runtime", lambda registry, one: "llama")
    return faults


def test_an_adapter_is_promoted_and_rolled_back(run_command, name, tmp_path, canary_faults):
    measured = tmp_path / "measured.json"
    measured.write_bytes(msgspec.json.encode(Measurement(trial_results(name, 21), trial_results("", 20))))
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "measured.json")
    assert code == ExitCode.FAILED_SAFELY
    assert "no measure is significantly better" in err
    measured.write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    canary_faults[name] = "it answers as if no adapter were loaded"
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "measured.json")
    assert (code, "as if no adapter" in err) == (ExitCode.FAILED_SAFELY, True)
    assert json.loads(run_command("adapters", "list", "--json")[1])["serving"] == []
    del canary_faults[name]
    assert run_command("adapters", "promote", name[:8], "--measured", "measured.json")[0] == ExitCode.SUCCESS
    assert json.loads(run_command("adapters", "list", "--json")[1])["serving"] == [name]
    code, _, err = run_command("adapters", "rollback", "--reason", "a test")
    assert code == ExitCode.SUCCESS
    assert "the bare base serves again" in err
    kinds = [entry["kind"] for entry in json.loads(run_command("adapters", "history", "--json")[1])["journal"]]
    assert kinds == ["added", "promoted", "rolled back"]
    assert run_command("adapters", "rollback", "--reason", "a test")[0] == ExitCode.SETUP


def test_an_adapter_is_listed_shown_verified_and_exported(run_command, name, tmp_path):
    assert name[:16] in run_command("adapters", "list")[1]
    assert json.loads(run_command("adapters", "show", name[:8])[1])["card"]["id"] == name
    assert run_command("adapters", "export", name[:8], "out")[0] == ExitCode.SUCCESS
    assert hash_weights(tmp_path / "out") == name
    assert run_command("adapters", "verify")[0] == ExitCode.SUCCESS
    (tmp_path / "adapters" / name / WEIGHTS_FILE).write_bytes(b"others")
    code, out, _ = run_command("adapters", "verify")
    assert code == ExitCode.FAILED_SAFELY
    assert "were changed" in out
    assert run_command("adapters", "export", name[:8], "out2")[0] == ExitCode.SETUP
    assert not (tmp_path / "out2").exists()


def test_an_export_is_complete_or_absent_and_readable_by_others(run_command, name, tmp_path):
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
def test_every_command_accepts_all_names_of_an_adapter(run_command, name, tmp_path, canary_faults, prefix):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", prefix + name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    trained_folder = tmp_path / "source of weights"
    packaged = read_adapter_card(packaged_folder("base-135m")).id
    names = {name[:8]: name, "champion": name, str(trained_folder): name, "base-135m": packaged}
    for number, (short, one) in enumerate(names.items()):
        code, out, err = run_command("adapters", "show", prefix + short)
        assert (code, json.loads(out)["card"]["id"]) == (ExitCode.SUCCESS, one), err
        assert run_command("adapters", "export", prefix + short, f"out{number}")[0] == ExitCode.SUCCESS
        assert hash_weights(tmp_path / f"out{number}") == one
    assert (
        run_command("adapters", "diff", prefix + "base-135m", f"{prefix}starter-135m", "--json")[0] == ExitCode.SUCCESS
    )
    for arguments in (
        ("show", prefix + "champion"),
        ("export", prefix + "champion", "none"),
        ("diff", "champion", name),
    ):
        code, _, err = run_command("adapters", *arguments, "--robot", "ur5e")
        assert (code, "There is no champion of ur5e" in err) == (ExitCode.SETUP, True)
    code, _, err = run_command("adapters", "show", prefix + "unknown")
    assert (code, "base-135m, champion" in err) == (ExitCode.SETUP, True)


@pytest.fixture
def measurable(monkeypatch):
    """Replace all checks of a measurement that come before the one of the champion."""
    monkeypatch.setattr("dualbrain.adaptation.curation.dataset.read_dataset", lambda folder: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.compatibility.require_same_prompt", lambda card: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.compatibility.require_compatible", lambda *args: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.stacking.locate_weights", lambda *args: None)
    monkeypatch.setattr("dualbrain.adaptation.adapters.stacking.read_lora", lambda *args: ())


@pytest.mark.parametrize("measured", [True, False])
def test_a_damaged_champion_is_reported_with_the_remedy(
    run_command, name, tmp_path, canary_faults, measurable, measured
):
    another = add_adapter(tmp_path, "more weights")
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    (tmp_path / "adapters" / name / WEIGHTS_FILE).write_bytes(b"others")
    measure = ("adapters", "measure", another, "--data", "data", "--out", "o.json")
    code, _, err = run_command(*(measure if measured else ("plan", "go", "--planner", "adapter:champion")))
    assert (code, f"champion {name[:16]}" in err, "dualbrain adapters rollback" in err) == (ExitCode.SETUP, True, True)


@pytest.mark.parametrize("named", [True, False])
def test_the_champion_cannot_be_a_candidate(run_command, name, tmp_path, canary_faults, measurable, named):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    who = name[:8] if named else "champion"
    code, _, err = run_command("adapters", "measure", who, "--data", "data", "--out", "o.json")
    assert (code, "The candidate is the champion itself" in err) == (ExitCode.SETUP, True)


def change_config(folder, **settings):
    path = folder / "adapter_config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **settings}))


@pytest.mark.parametrize("form", ["peft", "hub", "gguf"])
def test_only_plain_lora_is_exported(run_command, tmp_path, form):
    """An adapter that no runtime of this package serves gets no copy either."""
    folder = tmp_path / "source of weights"
    add_adapter(tmp_path)
    change_config(folder, use_dora=True)
    code, _, err = run_command("adapters", "export", str(folder), "out", "--form", form)
    assert (code, "use_dora" in err, (tmp_path / "out").exists()) == (ExitCode.SETUP, True, False)


def test_missing_hashes_are_reported_and_changed_adapters_not_exported(run_command, name, tmp_path):
    assert "recorded" not in run_command("adapters", "verify")[1]
    change_config(tmp_path / "adapters" / name, lora_alpha=64)
    code, out, _ = run_command("adapters", "verify")
    assert (code, "adapter_config.json of adapter" in out) == (ExitCode.FAILED_SAFELY, True)
    assert run_command("adapters", "export", name[:8], "out")[0] == ExitCode.SETUP
    strip_file_hashes(AdapterRegistry(tmp_path / "adapters"), name)
    code, out, _ = run_command("adapters", "verify")
    assert (code, "intact; config and card were not recorded" in out) == (ExitCode.SUCCESS, True)
    assert run_command("adapters", "export", name[:8], "out")[0] == ExitCode.SUCCESS


def test_one_damaged_adapter_hides_no_other(run_command, name, tmp_path, canary_faults):
    second = add_adapter(tmp_path, "more weights", beside=name)
    for one, before in ((name, ""), (second, name)):
        (tmp_path / "m.json").write_bytes(
            msgspec.json.encode(Measurement(trial_results(one, 58), trial_results(before, 20)))
        )
        assert run_command("adapters", "promote", one[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    (tmp_path / "adapters" / name / WEIGHTS_FILE).write_bytes(b"others")
    output = json.loads(run_command("adapters", "list", "--json")[1])
    assert ([card["id"] for card in output["adapters"]], output["serving"]) == ([second], [second])
    assert "were changed" in output["damaged"][name]
    assert second[:16] in run_command("adapters", "list")[1]
    code, out, _ = run_command("adapters", "show", name[:8])
    assert (code, [e["kind"] for e in json.loads(out)["journal"]]) == (ExitCode.FAILED_SAFELY, ["added", "promoted"])
    assert run_command("adapters", "verify")[1].count("intact") == 1
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SETUP
    code, _, err = run_command("adapters", "rollback", "--reason", "a test")
    assert (code, "the bare base serves again" in err) == (ExitCode.SUCCESS, True)  # the former one is damaged


@pytest.mark.parametrize("base", ["smollm2-135m-instruct", "base-135m"])
@pytest.mark.parametrize("named", [True, False])
def test_a_rollback_selects_the_base_by_name_or_that_of_the_champion(run_command, tmp_path, canary_faults, base, named):
    one = add_adapter(tmp_path, base=base)
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(one, 58), trial_results("", 20))))
    run_command("adapters", "promote", one[:8], "--measured", "m.json")
    code, _, err = run_command("adapters", "rollback", "--reason", "a test", *(("--base", base) if named else ()))
    assert (code, "the bare base serves again" in err) == (ExitCode.SUCCESS, True)
    assert json.loads(run_command("adapters", "list", "--json")[1])["serving"] == []


def last_entry(home):
    """The newest entry of the log."""
    return AdapterRegistry(home / "adapters").entries()[-1]


def test_a_promotion_needs_shadow_answers_unless_they_are_waived(run_command, name, tmp_path, canary_faults):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    write_shadow_log(tmp_path, name, n_complete=MIN_SHADOW_ANSWERS - 1, n_incomplete=5)
    canary_faults[name] = "the canaries must not be asked before"
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
    assert (code, f"{MIN_SHADOW_ANSWERS - 1} of {MIN_SHADOW_ANSWERS} complete shadow answers" in err) == (
        ExitCode.FAILED_SAFELY,
        True,
    )
    assert f"shadow:{name[:16]}" in err
    assert last_entry(tmp_path).kind == "added"
    for served in ("smollm2-135m-instruct+" + name[:16], "another"):  # the candidate itself, or an unknown planner
        write_shadow_log(tmp_path, name, n_complete=99, served=served)
        assert (
            f"0 of {MIN_SHADOW_ANSWERS} complete shadow answers"
            in run_command("adapters", "promote", name[:8], "--measured", "m.json")[2]
        )
    write_shadow_log(
        tmp_path, name, n_complete=MIN_SHADOW_ANSWERS - 1, n_incomplete=5, served="smollm2-135m-instruct in torch"
    )
    del canary_faults[name]
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", "-1")[0] == ExitCode.USAGE
    assert (
        run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", MIN_SHADOW_ANSWERS - 1)[0]
        == ExitCode.SUCCESS
    )
    assert last_entry(tmp_path).reason == f"{MIN_SHADOW_ANSWERS - 1} answers in the shadow"
    run_command("adapters", "rollback", "--reason", "a test")
    shadow_log_path(tmp_path / "adapters", name).unlink()
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", 0)[0] == ExitCode.SUCCESS
    assert last_entry(tmp_path).reason == "the shadow was waived, with 0 answers in it"
    assert "the shadow was waived" in run_command("adapters", "history")[1]


SERVING_PLANNERS = (
    DEFAULT_PLANNER,
    f"{DEFAULT_PLANNER} in torch",
    "smollm2-135m-instruct",
    "base-135m",
    "mine@localhost",
)


@pytest.mark.parametrize("served", SERVING_PLANNERS)
def test_without_a_champion_the_shadow_of_any_serving_planner_counts(
    run_command, name, tmp_path, canary_faults, served
):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    second = add_adapter(tmp_path, "more weights")
    for author in (f"smollm2-135m-instruct+{one[:16]}" for one in (second, name)):
        write_shadow_log(tmp_path, name, n_complete=MIN_SHADOW_ANSWERS, served=author)
        code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
        message = " ".join(err.split())
        assert (code, f"shadow:{name[:16]}@{DEFAULT_PLANNER}`, or with another serving planner" in message) == (1, True)
    write_shadow_log(tmp_path, name, n_complete=MIN_SHADOW_ANSWERS, served=served)
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
    message = " ".join(err.split())
    assert code == ExitCode.SUCCESS
    assert f"adapter {name[:16]} on smollm2-135m-instruct is the champion of panda now" in message
    assert "`--planner adapter:champion`" in message
    (tmp_path / "m.json").write_bytes(
        msgspec.json.encode(Measurement(trial_results(second, 58), trial_results(name, 20)))
    )
    write_shadow_log(tmp_path, second, n_complete=MIN_SHADOW_ANSWERS, served=served)
    code, _, err = run_command("adapters", "promote", second[:8], "--measured", "m.json")
    assert (code, f"0 of {MIN_SHADOW_ANSWERS} complete shadow answers" in err, "@" in err) == (
        ExitCode.FAILED_SAFELY,
        True,
        False,
    )


def test_a_measurement_of_other_adapters_is_reported_before_anything_is_asked(run_command, name, tmp_path, monkeypatch):
    (tmp_path / "m.json").write_bytes(
        msgspec.json.encode(Measurement(trial_results("another", 58), trial_results("", 20)))
    )
    for function in ("count_shadow_answers", "canary_error", "serving_runtime"):
        monkeypatch.setattr(f"dualbrain.cli.adapters.registry.{function}", lambda *args: pytest.fail("called"))
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json")
    assert (code, "The measurement compares another with" in err, "gain +" in err) == (ExitCode.SETUP, True, False)


@pytest.mark.parametrize("fault", ["", "canary 0 was answered differently"])
def test_a_rollback_checks_the_former_champion_and_reports_the_result(
    run_command, name, tmp_path, canary_faults, fault
):
    second = add_adapter(tmp_path, "more weights", beside=name)
    for one, before in ((name, ""), (second, name)):
        (tmp_path / "m.json").write_bytes(
            msgspec.json.encode(Measurement(trial_results(one, 58), trial_results(before, 20)))
        )
        run_command("adapters", "promote", one[:8], "--measured", "m.json")
    canary_faults[name] = fault
    code, _, err = run_command("adapters", "rollback", "--reason", "a test")
    assert (last_entry(tmp_path).kind, last_entry(tmp_path).adapter) == ("rolled back", name)
    assert f"{name[:16]} serves again" in err
    assert code == (ExitCode.FAILED_SAFELY if fault else ExitCode.SUCCESS)
    assert (f"will make no proposals: {fault}" if fault else "canary answers are the recorded ones") in err
    assert (
        run_command("adapters", "rollback", "--reason", "a test")[0] == ExitCode.SUCCESS
    )  # the bare base has no canaries


def test_the_log_names_the_data_set_of_the_measurement(run_command, name, tmp_path, canary_faults):
    measured = Measurement(trial_results(name, 58), trial_results("", 20), "d" * 64)
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(measured))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    assert AdapterRegistry(tmp_path / "adapters").entries()[-1].decision.dataset == "d" * 64


def test_a_promotion_needs_a_measurement_in_the_serving_runtime(run_command, name, tmp_path, canary_faults):
    elsewhere = Measurement(trial_results(name, 58, runtime="another"), trial_results("", 20, runtime="another"))
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(elsewhere))
    code, _, err = run_command("adapters", "promote", name[:8], "--measured", "m.json", "--shadow", 0)
    assert (
        code,
        "measured in the runtime another, but it is served in llama. Measure again" in " ".join(err.split()),
    ) == (5, True)
    assert last_entry(tmp_path).kind == "added"


@pytest.mark.parametrize("kept", [True, False])
def test_adapters_that_serve_in_another_runtime_than_measured_are_reported(
    run_command, name, tmp_path, canary_faults, monkeypatch, kept
):
    (tmp_path / "m.json").write_bytes(msgspec.json.encode(Measurement(trial_results(name, 58), trial_results("", 20))))
    assert run_command("adapters", "promote", name[:8], "--measured", "m.json")[0] == ExitCode.SUCCESS
    assert last_entry(tmp_path).decision.runtime == "llama"
    assert json.loads(run_command("adapters", "list", "--json")[1])["measured_elsewhere"] == {}
    if kept:
        monkeypatch.setattr("dualbrain.cli.adapters.registry.serving_runtime", lambda registry, one: "llama 2")
    else:
        log = tmp_path / "adapters" / "journal.jsonl"
        log.write_text(log.read_text().replace(',"runtime":"llama"', ""))
    words = "was measured in " + ("llama: " if kept else "a runtime that was not recorded: ")
    code, out, _ = run_command("adapters", "verify")
    assert (code, words in out) == (ExitCode.SUCCESS, True)
    assert words in json.loads(run_command("adapters", "list", "--json")[1])["measured_elsewhere"][name]
    assert words in " ".join(run_command("adapters", "list")[2].split())


@pytest.mark.parametrize("base", [(), ("--base", "base-135m")])
def test_without_a_registry_there_is_nothing_to_roll_back(run_command, tmp_path, base):
    code, out, err = run_command("adapters", "rollback", "--reason", "a test", *base)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "There is no " in err
    assert not (tmp_path / "adapters").exists()


@pytest.mark.parametrize("arguments", [("show", "abcd"), ("promote", "abcd", "--measured", "none.json")])
def test_a_missing_adapter_or_file_is_reported(run_command, arguments):
    code, out, err = run_command("adapters", *arguments)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "abcd" in err or "none.json" in err


def test_a_lost_log_is_reported(run_command, name, tmp_path):
    (tmp_path / "adapters" / "journal.jsonl").rename(tmp_path / "elsewhere")
    code, out, _ = run_command("adapters", "verify")
    assert (code, f"{name[:16]} its folder exists, but the registry log has no entry" in out) == (
        ExitCode.FAILED_SAFELY,
        True,
    )
    assert "config and card were not recorded" not in out
    assert name in json.loads(run_command("adapters", "list", "--json")[1])["damaged"]
    assert "its folder exists" in run_command("adapters", "list")[2]


def test_ids_are_complete_in_a_narrow_terminal(run_command, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "24")
    assert name[:16] in run_command("adapters", "list")[1]


def test_an_unknown_base_is_reported_with_the_known_ones(run_command, name):
    for base in ("nope", "minilm-l6-v2-int8"):  # an encoder is not a base
        code, _, err = run_command("adapters", "rollback", "--reason", "a test", "--base", base)
        assert (code, f"'{base}' is not a base." in err) == (ExitCode.SETUP, True)
        models = "qwen2.5-coder-0.5b-instruct, qwen2.5-coder-1.5b-instruct, smollm2-135m-instruct"
        assert err.partition("Known: ")[2] == f"base-135m, explored-135m, {models}, starter-135m.\n"


def test_an_empty_registry_is_not_an_error(run_command):
    for command in ("list", "verify"):
        code, out, err = run_command("adapters", command)
        assert (code, out, "dualbrain adapt" in " ".join(err.split())) == (ExitCode.SUCCESS, "", True)
    assert json.loads(run_command("adapters", "list", "--json")[1]) == {
        "adapters": [],
        "serving": [],
        "damaged": {},
        "measured_elsewhere": {},
    }


def test_an_export_for_the_hub_has_the_weights_and_a_card_and_states_a_measurement(run_command, name, tmp_path):
    measured = tmp_path / "measured.json"
    measured.write_bytes(msgspec.json.encode(Measurement(trial_results(name, 30), trial_results("", 31))))
    options = ("--form", "hub", "--measured", "measured.json")
    assert run_command("adapters", "export", name[:8], "hub", *options)[0] == ExitCode.SUCCESS
    assert {file.name for file in (tmp_path / "hub").iterdir()} == {*ADAPTER_FILES, "README.md"}
    assert hash_weights(tmp_path / "hub") == name
    assert read_adapter_card(tmp_path / "hub") == read_adapter_card(tmp_path / "adapters" / name)
    own, config = (
        json.loads((folder / "adapter_config.json").read_text())
        for folder in (tmp_path / "adapters" / name, tmp_path / "hub")
    )
    assert config == {**own, "base_model_name_or_path": "HuggingFaceTB/SmolLM2-135M-Instruct"}
    assert "**Not promoted**" in (tmp_path / "hub" / "README.md").read_text()
    measured.write_bytes(msgspec.json.encode(Measurement(trial_results("o" * 64, 30), trial_results("", 31))))
    code, _, err = run_command("adapters", "export", name[:8], "other", *options)
    assert (code, "The measurement is of oooo" in err) == (ExitCode.SETUP, True)
    assert not (tmp_path / "other").exists()
    code, _, err = run_command("adapters", "export", name[:8], "other", "--measured", "measured.json")
    assert (code, "with --form hub only" in err) == (ExitCode.USAGE, True)
