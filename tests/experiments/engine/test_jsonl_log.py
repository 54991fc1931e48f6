import json
import lzma

from hypothesis import given
from hypothesis import strategies as st

from experiments.engine.jsonl_log import JsonlLog


def test_a_row_is_on_disk_when_append_returns(tmp_path):
    journal = JsonlLog(tmp_path / "deep" / "a.jsonl")
    journal.append({"key": "one", "value": 1.5})
    assert json.loads(journal.path.read_text()) == {"key": "one", "value": 1.5}
    assert journal.finished_keys() == {"one"}


@given(cut=st.integers(1, 200))
def test_a_kill_while_writing_loses_that_row_only(cut, tmp_path_factory):
    journal = JsonlLog(tmp_path_factory.mktemp("journal") / "a.jsonl")
    for name in ("one", "two"):
        journal.append({"key": name})
    whole = journal.path.read_bytes()
    torn = (json.dumps({"key": "three", "text": "x" * 200}) + "\n").encode()[:cut]
    journal.path.write_bytes(whole + torn)
    assert journal.finished_keys() == {"one", "two"}
    journal.append({"key": "four"})
    assert journal.finished_keys() == {"one", "two", "four"}


def test_an_error_is_done_again_and_the_last_word_counts(tmp_path):
    journal = JsonlLog(tmp_path / "a.jsonl")
    journal.append({"key": "one", "error": "broke"})
    assert journal.finished_keys() == set()
    journal.append({"key": "one", "value": 2})
    assert journal.rows() == [{"key": "one", "value": 2}]
    assert journal.finished_keys() == {"one"}


def test_no_file_means_nothing_done(tmp_path):
    assert JsonlLog(tmp_path / "none.jsonl").rows() == []


def test_a_kept_journal_is_where_another_checkout_begins(tmp_path):
    journal, kept = JsonlLog(tmp_path / "here" / "a.jsonl"), tmp_path / "kept" / "a.jsonl.xz"
    journal.restore_from(kept)
    assert journal.rows() == []
    journal.append({"key": "a", "value": 1})
    journal.append({"key": "b", "error": "broke"})
    journal.append({"key": "a", "value": 2})
    journal.pack_to(kept)
    assert len(lzma.decompress(kept.read_bytes()).splitlines()) == 2
    elsewhere = JsonlLog(tmp_path / "there" / "a.jsonl")
    elsewhere.restore_from(kept)
    assert elsewhere.rows() == journal.rows()
    elsewhere.append({"key": "b", "value": 3})
    elsewhere.restore_from(kept)
    assert elsewhere.finished_keys() == {"a", "b"}
