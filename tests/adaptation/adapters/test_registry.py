"""The registry: its content never changes, only a decision of the gate promotes, and a crash loses nothing."""

import json
import os
import resource
import stat

import pytest
from msgspec.structs import replace

from dualbrain.adaptation.adapters.card import (
    CONFIG_FILE,
    METADATA_FILES,
    WEIGHTS_FILE,
    AdapterCard,
    hash_weights,
    read_adapter_card,
    write_adapter_card,
)
from dualbrain.adaptation.adapters.naming import champion_id, resolve_folder
from dualbrain.adaptation.adapters.promotion import PromotionDecision
from dualbrain.adaptation.adapters.registry import (
    LOG_FILE,
    NO_ADAPTER,
    UNRECORDED_FAULT,
    AdapterRegistry,
    NotPromotedError,
    place_of_card,
)
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.errors import ConfigurationError, UnknownNameError

PLACE = ("panda", "b" * 64)


def make_adapter(folder, content, robot="panda", base="b" * 64):
    """An adapter as training leaves it, with `content` as weights."""
    folder.mkdir()
    (folder / WEIGHTS_FILE).write_bytes(content.encode())
    (folder / "adapter_config.json").write_text("{}")
    card = AdapterCard(
        id=hash_weights(folder),
        base="smollm2",
        base_sha256=base,
        robot=robot,
        registry="r1",
        prompt="p1",
        dataset="d",
        sources={},
        bootstrapped=False,
        precision="float32",
        steps=7,
        held_out=None,
        config=AdaptConfig(),
        versions={},
    )
    write_adapter_card(card, folder)
    return folder


@pytest.fixture
def registry(tmp_path):
    return AdapterRegistry(tmp_path / "adapters")


@pytest.fixture
def two(registry, tmp_path):
    """A registry with two adapters, and their ids."""
    return [registry.add(make_adapter(tmp_path / words, words), now=1.0).id for words in ("first", "second")]


def strip_file_hashes(registry, one):
    """Remove the hashes of config and card of `one` from the log, as in logs of older versions."""
    path = registry.folder / LOG_FILE
    lines = [json.loads(line) for line in path.read_bytes().splitlines()]
    lines = [{key: line[key] for key in line if key != "files" or line["adapter"] != one} for line in lines]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def decision_for(candidate, champion, against=()):
    return PromotionDecision(candidate=candidate, champion=champion, measures={}, against=tuple(against))


def test_a_folder_without_a_config_is_rejected_with_the_name_of_the_file(registry, tmp_path):
    folder = make_adapter(tmp_path / "made", "first")
    (folder / "adapter_config.json").unlink()
    with pytest.raises(ConfigurationError, match=r"no adapter_config\.json"):
        registry.add(folder, now=1.0)
    assert not registry.ids()


def test_the_registry_is_private_with_every_umask(registry, tmp_path):
    before = os.umask(0)
    try:
        registry.add(make_adapter(tmp_path / "made", "first"), now=1.0)
    finally:
        os.umask(before)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (registry.folder, *registry.folder.rglob("*"))}
    assert {path: oct(bits) for path, bits in modes.items() if bits & 0o077} == {}
    assert len(modes) >= 6


def test_an_id_always_denotes_the_same_content(registry, two, tmp_path):
    assert registry.ids() == tuple(two)
    again = make_adapter(tmp_path / "again", "first")
    (again / "adapter_config.json").write_text('{"peft_version": "9"}')
    assert registry.add(again, now=2.0).id == two[0]
    assert registry.ids() == tuple(two)
    assert (registry.folder / two[0] / "adapter_config.json").read_text() == "{}"
    assert registry.find(two[0][:8]) == two[0]
    for name in ("", "zz", two[0] + "0"):
        with pytest.raises(UnknownNameError):
            registry.find(name)


@pytest.mark.parametrize("known", [True, False])
def test_registered_weights_are_rejected_with_another_config_or_card(registry, two, tmp_path, known):
    """Also if no hashes are recorded for the registered adapter."""
    if not known:
        strip_file_hashes(registry, two[0])
    before, log = contents(registry.folder), registry.entries()
    again = make_adapter(tmp_path / "again", "first")
    (again / CONFIG_FILE).write_text('{"lora_alpha": 64}')
    with pytest.raises(ConfigurationError, match=r"another adapter_config\.json\..*denotes one content"):
        registry.add(again, now=2.0)
    for words, changed in (
        ("robot", {"robot": "ur5e"}),
        ("dataset", {"dataset": "e"}),
        ("scene_values", {"scene_values": True}),
        ("bootstrapped", {"bootstrapped": True}),
        ("", {"versions": {"a": "1"}, "steps": 9}),
    ):
        again = make_adapter(tmp_path / f"again {words}", "first")
        write_adapter_card(replace(read_adapter_card(again), **changed), again)
        if words:
            with pytest.raises(ConfigurationError, match=f"another {words} in adapter.json"):
                registry.add(again, now=2.0)
        else:
            assert registry.add(again, now=2.0).id == two[0]
    assert (contents(registry.folder), registry.entries()) == (before, log)


def test_adding_a_damaged_adapter_again_reports_the_damage(registry, two, tmp_path):
    (registry.folder / two[0] / CONFIG_FILE).write_text('{"lora_alpha": 64}')
    with pytest.raises(ConfigurationError, match="was changed"):
        registry.add(tmp_path / "first", now=2.0)


def test_promote_and_roll_back_are_a_stack(registry, two):
    first, second = two
    assert registry.champion(PLACE) == NO_ADAPTER
    registry.promote(first, decision_for(first, NO_ADAPTER), now=2.0)
    registry.promote(second, decision_for(second, first), now=3.0)
    assert registry.champion(PLACE) == second
    assert registry.champion(("ur5e", "b" * 64)) == NO_ADAPTER
    assert registry.roll_back(PLACE, "a test", now=4.0) == first
    assert registry.champion(PLACE) == first
    registry.promote(second, decision_for(second, first), now=5.0)
    assert [registry.roll_back(PLACE, "a test", now=6.0) for _ in range(2)] == [first, NO_ADAPTER]
    with pytest.raises(ConfigurationError, match="bare base"):
        registry.roll_back(PLACE, "a test", now=7.0)
    with pytest.raises(ConfigurationError, match="reason"):
        registry.roll_back(PLACE, " ", now=7.0)
    assert [entry.time for entry in registry.entries()] == [1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 6.0]


def test_only_a_decision_in_favour_about_these_two_promotes(registry, two):
    first, second = two
    with pytest.raises(NotPromotedError, match="it fell") as refused:
        registry.promote(first, decision_for(first, NO_ADAPTER, ["it fell"]), now=2.0)
    assert refused.value.reasons == ("it fell",)
    for decision in (decision_for(second, NO_ADAPTER), decision_for(first, second)):
        with pytest.raises(ConfigurationError, match="The measurement compares"):
            registry.promote(first, decision, now=2.0)
    assert registry.champion(PLACE) == NO_ADAPTER
    registry.promote(first, decision_for(first, NO_ADAPTER), now=2.0)
    with pytest.raises(ConfigurationError, match="Measure again"):
        registry.promote(second, decision_for(second, NO_ADAPTER), now=3.0)
    assert registry.champion(PLACE) == first


def test_changed_weights_are_detected_and_not_promoted(registry, two):
    path = registry.folder / two[0] / WEIGHTS_FILE
    path.write_bytes(b"f1rst")
    assert registry.verify()[two[1]] == ""
    assert "were changed" in registry.verify()[two[0]]
    with pytest.raises(ConfigurationError, match="were changed"):
        registry.promote(two[0], decision_for(two[0], NO_ADAPTER), now=2.0)
    assert registry.champion(PLACE) == NO_ADAPTER


@pytest.mark.parametrize("file", METADATA_FILES)
def test_a_changed_config_or_card_is_detected_like_changed_weights(registry, two, file):
    first, second = two
    registry.promote(first, decision_for(first, NO_ADAPTER), now=2.0)
    path = registry.folder / first / file
    whole = path.read_bytes()
    for changed in (whole.replace(b"{", b'{"lora_alpha": 64, ', 1), None):
        path.write_bytes(changed) if changed else path.unlink()
        assert file in registry.verify()[first]
        assert registry.verify()[second] == ""
        for read in (registry.card, registry.adapter_folder, lambda name: resolve_folder(f"adapter:{name}", registry)):
            with pytest.raises(ConfigurationError, match=f"{file} of adapter.*was changed"):
                read(first)
        with pytest.raises(ConfigurationError, match="was changed"):
            resolve_folder("adapter:champion", registry, "panda")
    registry.promote(second, decision_for(second, first), now=3.0)
    assert registry.roll_back(PLACE, "a test", now=4.0) == NO_ADAPTER  # the damaged one is skipped
    path.write_bytes(whole)
    assert registry.verify()[first] == ""


def test_an_adapter_without_recorded_hashes_of_config_and_card_can_serve(registry, two):
    strip_file_hashes(registry, two[0])
    (registry.folder / two[0] / CONFIG_FILE).write_text('{"lora_alpha": 64}')
    assert (registry.recorded_hashes(two[0]), set(registry.recorded_hashes(two[1]))) == ({}, set(METADATA_FILES))
    assert set(registry.verify().values()) == {""}
    registry.promote(two[0], decision_for(two[0], NO_ADAPTER), now=2.0)
    assert resolve_folder("adapter:champion", registry, "panda") == registry.folder / two[0]
    (registry.folder / two[0] / WEIGHTS_FILE).write_bytes(b"f1rst")
    assert "were changed" in registry.verify()[two[0]]


def test_a_damaged_adapter_is_not_added(registry, tmp_path):
    bad = make_adapter(tmp_path / "bad", "bad")
    (bad / WEIGHTS_FILE).write_bytes(b"worse")
    with pytest.raises(ConfigurationError, match="were changed"):
        registry.add(bad, now=1.0)
    assert registry.ids() == ()


def test_an_incomplete_last_line_of_the_log_is_ignored(registry, two):
    registry.promote(two[0], decision_for(two[0], NO_ADAPTER), now=2.0)
    path = registry.folder / LOG_FILE
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines(keepends=True)[-1][:-7])
    assert registry.champion(PLACE) == two[0]
    assert registry.roll_back(PLACE, "a test", now=3.0) == NO_ADAPTER
    assert [json.loads(line)["kind"] for line in path.read_text().splitlines()][-2:] == ["promoted", "rolled back"]


@pytest.mark.parametrize("kept", [0, 1])
def test_an_adapter_without_a_log_entry_is_a_fault_until_it_is_added_again(registry, two, tmp_path, kept):
    path = registry.folder / LOG_FILE
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:kept]))
    (registry.folder / "canaries").mkdir()
    lost = two[kept:]
    assert set(registry.unrecorded_ids()) == set(lost)
    for one in two:
        assert registry.verify()[one] == (UNRECORDED_FAULT if one in lost else "")
    for words in ("first", "second"):
        registry.add(tmp_path / words, now=9.0)
    assert registry.verify() == dict.fromkeys(two, "")
    assert registry.recorded_hashes(two[1])


def test_a_damaged_log_is_reported(registry, two):
    path = registry.folder / LOG_FILE
    path.write_bytes(b"{}\n" + path.read_bytes())
    with pytest.raises(ConfigurationError, match="log of the adapter registry is damaged"):
        registry.champion(PLACE)


@pytest.mark.parametrize("n_bytes_left", [0, 10, 100])
def test_a_full_disk_leaves_registry_and_champion_unchanged(registry, two, tmp_path, n_bytes_left):
    registry.promote(two[0], decision_for(two[0], NO_ADAPTER), now=2.0)
    before = {path: path.read_bytes() for path in registry.folder.rglob("*") if path.is_file()}
    third = make_adapter(tmp_path / "third", "third" * 100)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    n_log_bytes = len((registry.folder / LOG_FILE).read_bytes())
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes_left, limits[1]))
    try:
        with pytest.raises(FileWriteError):
            registry.add(third, now=3.0)
        resource.setrlimit(resource.RLIMIT_FSIZE, (n_log_bytes + n_bytes_left, limits[1]))
        with pytest.raises(FileWriteError):
            registry.promote(two[1], decision_for(two[1], two[0]), now=3.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path: path.read_bytes() for path in registry.folder.rglob("*") if path.is_file()} == before
    assert registry.champion(PLACE) == two[0]
    registry.promote(two[1], decision_for(two[1], two[0]), now=4.0)
    assert registry.champion(PLACE) == two[1]


def test_the_place_of_an_adapter_is_its_robot_and_base(registry, two):
    assert place_of_card(registry.card(two[0])) == PLACE


def test_adding_an_adapter_changes_no_champion(registry, two, tmp_path):
    """On the same base or on another one."""
    with pytest.raises(ConfigurationError, match="champion of panda"):
        champion_id(registry, "panda")
    registry.promote(two[0], decision_for(two[0], NO_ADAPTER), now=3.0)
    for words, base in (("other", "c" * 64), ("third", "b" * 64)):
        registry.add(make_adapter(tmp_path / words, words, base=base), now=4.0)
        assert champion_id(registry, "panda") == two[0]
    registry.promote(two[1], decision_for(two[1], two[0]), now=5.0)
    assert champion_id(registry, "panda") == two[1]
    registry.roll_back(PLACE, "a test", now=6.0)
    assert champion_id(registry, "panda") == two[0]


def test_a_robot_is_served_on_one_base_at_a_time(registry, two, tmp_path):
    """A measurement against the bare base of another model is not a measurement against the champion."""
    other = registry.add(make_adapter(tmp_path / "other", "other", base="c" * 64), now=2.0)
    registry.promote(two[0], decision_for(two[0], NO_ADAPTER), now=3.0)
    before = registry.entries()
    with pytest.raises(ConfigurationError, match=rf"champion of panda is {two[0][:16]}, on another base.*rollback"):
        registry.promote(other.id, decision_for(other.id, NO_ADAPTER), now=4.0)
    assert registry.entries() == before
    registry.roll_back(PLACE, "a test", now=5.0)
    registry.promote(other.id, decision_for(other.id, NO_ADAPTER), now=6.0)
    assert champion_id(registry, "panda") == other.id


def test_a_rollback_without_a_registry_fails_and_creates_none(registry):
    with pytest.raises(ConfigurationError, match="There is no adapter registry"):
        registry.roll_back(PLACE, "a test", now=1.0)
    assert not registry.folder.exists()
