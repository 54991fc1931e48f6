import json
import lzma

from hypothesis import given
from hypothesis import strategies as st

from experiments.engine.jsonl_log import Journal


def test_a_row_is_on_disk_when_append_returns(tmp_path):
    journal = Journal(tmp_path / "deep" / "a.jsonl")
    journal.append({"key": "one", "value": 1.5})
    assert json.loads(journal.path.read_text()) == {"key": "one", "value": 1.5}
    assert journal.finished() == {"one"}


@given(cut=st.integers(1, 200))
def test_a_kill_while_writing_loses_that_row_only(cut, tmp_path_factory):
    journal = Journal(tmp_path_factory.mktemp("journal") / "a.jsonl")
    for name in ("one", "two"):
        journal.append({"key": name})
    whole = journal.path.read_bytes()
    torn = (json.dumps({"key": "three", "text": "x" * 200}) + "\n").encode()[:cut]
    journal.path.write_bytes(whole + torn)
    assert journal.finished() == {"one", "two"}
    journal.append({"key": "four"})
    assert journal.finished() == {"one", "two", "four"}


def test_an_error_is_done_again_and_the_last_word_counts(tmp_path):
    journal = Journal(tmp_path / "a.jsonl")
    journal.append({"key": "one", "error": "broke"})
    assert journal.finished() == set()
    journal.append({"key": "one", "value": 2})
    assert journal.rows() == [{"key": "one", "value": 2}]
    assert journal.finished() == {"one"}


def test_no_file_means_nothing_done(tmp_path):
    assert Journal(tmp_path / "none.jsonl").rows() == []


def test_a_kept_journal_is_where_another_checkout_begins(tmp_path):
    journal, kept = Journal(tmp_path / "here" / "a.jsonl"), tmp_path / "kept" / "a.jsonl.xz"
    journal.begin_with(kept)
    assert journal.rows() == []
    journal.append({"key": "a", "value": 1})
    journal.append({"key": "b", "error": "broke"})
    journal.append({"key": "a", "value": 2})
    journal.copy_to(kept)
    assert len(lzma.decompress(kept.read_bytes()).splitlines()) == 2
    elsewhere = Journal(tmp_path / "there" / "a.jsonl")
    elsewhere.begin_with(kept)
    assert elsewhere.rows() == journal.rows()
    elsewhere.append({"key": "b", "value": 3})
    elsewhere.begin_with(kept)
    assert elsewhere.finished() == {"a", "b"}
