import json
import lzma
import math
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.storage.jsonl_log import JsonlLog


def test_a_line_is_on_disk_when_append_returns(tmp_path):
    log = JsonlLog(tmp_path / "deep" / "a.jsonl")
    log.append({"key": "one", "value": 1.5})
    assert json.loads(log.path.read_text()) == {"key": "one", "value": 1.5}
    assert log.finished_keys() == {"one"}


@pytest.fixture
def synced(monkeypatch):
    """The inodes of the files and folders that were synced to the disk, in their order."""
    inodes, fsync = [], os.fsync

    def recording_fsync(descriptor):
        inodes.append(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", recording_fsync)
    return inodes


def test_the_first_line_syncs_the_entries_of_the_file_and_of_new_folders(tmp_path, synced):
    log = JsonlLog(tmp_path / "new" / "deep" / "a.jsonl")
    log.append({"key": "one"})
    paths = (log.path, log.path.parent, tmp_path / "new", tmp_path)
    assert synced == [path.stat().st_ino for path in paths]
    log.append({"key": "two"})
    assert synced[len(paths) :] == [log.path.stat().st_ino]


def test_a_new_file_in_an_existing_folder_syncs_its_entry(tmp_path, synced):
    log = JsonlLog(tmp_path / "a.jsonl")
    log.append({"key": "one"})
    assert synced == [log.path.stat().st_ino, tmp_path.stat().st_ino]


@given(cut=st.integers(1, 200))
def test_a_kill_while_writing_loses_that_line_only(cut, tmp_path_factory):
    log = JsonlLog(tmp_path_factory.mktemp("log") / "a.jsonl")
    for name in ("one", "two"):
        log.append({"key": name})
    whole = log.path.read_bytes()
    torn = (json.dumps({"key": "three", "text": "x" * 200}) + "\n").encode()[:cut]
    log.path.write_bytes(whole + torn)
    assert log.finished_keys() == {"one", "two"}
    log.append({"key": "four"})
    assert log.finished_keys() == {"one", "two", "four"}


def test_a_torn_line_is_not_counted(tmp_path):
    log = JsonlLog(tmp_path / "rows.jsonl")
    log.append({"key": "a", "value": 1})
    with log.path.open("ab") as file:
        file.write(b'{"key": "b", "val')
    assert [line["key"] for line in log.read()] == ["a"]
    log.append({"key": "c"})
    assert [line["key"] for line in log.read()] == ["a", "c"]
    assert [number for number, _ in log.read_numbered()] == [1, 3]


def test_a_line_that_holds_no_object_is_ignored(tmp_path):
    log = JsonlLog(tmp_path / "a.jsonl")
    log.path.write_bytes(b"[1]\n\xff\n" + b"[" * 100_000 + b'\n{"key": "a"}\n')
    assert log.read_numbered() == [(4, {"key": "a"})]


def test_failed_work_is_repeated_and_the_last_line_of_a_key_counts(tmp_path):
    log = JsonlLog(tmp_path / "a.jsonl")
    log.append({"key": "one", "error": "broke"})
    assert log.finished_keys() == set()
    log.append({"key": "one", "value": 2})
    assert log.latest() == [{"key": "one", "value": 2}]
    assert log.finished_keys() == {"one"}


def test_without_a_file_nothing_is_finished(tmp_path):
    assert JsonlLog(tmp_path / "none.jsonl").latest() == []


def test_non_finite_numbers_come_back(tmp_path):
    log = JsonlLog(tmp_path / "a.jsonl")
    log.append({"key": "a", "values": [math.inf, -math.inf, math.nan]})
    above, below, undefined = log.read()[0]["values"]
    assert (above, below) == (math.inf, -math.inf)
    assert math.isnan(undefined)


def test_another_checkout_continues_from_a_packed_log(tmp_path):
    log, archive = JsonlLog(tmp_path / "here" / "a.jsonl"), tmp_path / "packed" / "a.jsonl.xz"
    log.restore_from(archive)
    assert log.latest() == []
    log.append({"key": "a", "value": 1})
    log.append({"key": "b", "error": "broke"})
    log.append({"key": "a", "value": 2})
    log.pack_to(archive)
    assert len(lzma.decompress(archive.read_bytes()).splitlines()) == 2
    elsewhere = JsonlLog(tmp_path / "there" / "a.jsonl")
    elsewhere.restore_from(archive)
    assert elsewhere.latest() == log.latest()
    elsewhere.append({"key": "b", "value": 3})
    elsewhere.restore_from(archive)
    assert elsewhere.finished_keys() == {"a", "b"}
