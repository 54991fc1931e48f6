import pytest
from proofs.document import BEGIN, END, write_documents
from proofs.journal import Journal


class Counting:
    name, claim = "counting", "One comes before two."

    def report(self, rows):
        return [f"{len(rows)} counted"]


def test_the_page_keeps_its_words_and_gets_new_figures(tmp_path):
    page, journal = tmp_path / "proofs.md", Journal(tmp_path / "counting.jsonl")
    page.write_text(f"# Before\n{BEGIN}\nold\n{END}\nafter\n")
    for key in ("one", "two"):
        journal.append({"key": key, "date": "2026-01-02", "revision": "abc", "load": 1.0, "wall_s": 3.0})
    journal.append({"key": "three", "error": "broke"})
    write_documents([Counting()], tmp_path, tmp_path)
    write_documents([Counting()], tmp_path, tmp_path)
    text = page.read_text()
    assert text.startswith("# Before\n" + BEGIN)
    assert text.endswith(END + "\nafter\n")
    assert text.count("2 counted") == text.count("revision abc (2)") == 1
    assert "old" not in text


def test_a_page_without_markers_is_not_written_over(tmp_path):
    (tmp_path / "proofs.md").write_text("words of a person")
    with pytest.raises(ValueError, match="unpack"):
        write_documents([], tmp_path, tmp_path)
