import pytest

from experiments.engine.documents import BEGIN_MARKER, END_MARKER, write_documents
from experiments.engine.jsonl_log import JsonlLog


class Counting:
    name, claim = "counting", "One comes before two."

    def report(self, rows):
        return [f"{len(rows)} counted"]


def test_the_page_keeps_its_words_and_gets_new_figures(tmp_path):
    page, journal = tmp_path / "proofs.md", JsonlLog(tmp_path / "counting.jsonl")
    page.write_text(f"# Before\n{BEGIN_MARKER}\nold\n{END_MARKER}\nafter\n")
    for key in ("one", "two"):
        journal.append({"key": key, "date": "2026-01-02", "revision": "abc", "load": 1.0, "wall_s": 3.0})
    journal.append({"key": "three", "error": "broke"})
    write_documents([Counting()], tmp_path, tmp_path)
    write_documents([Counting()], tmp_path, tmp_path)
    text = page.read_text()
    assert text.startswith("# Before\n" + BEGIN_MARKER)
    assert text.endswith(END_MARKER + "\nafter\n")
    assert text.count("2 counted") == text.count("revision abc (2)") == 1
    assert "old" not in text


def test_the_page_says_what_the_intervals_of_a_proof_are(tmp_path):
    class Bootstrapped(Counting):
        name, intervals = "bootstrapped", "bootstrap, 90 %"

    (tmp_path / "proofs.md").write_text(f"{BEGIN_MARKER}\n{END_MARKER}\n")
    for name in ("counting", "bootstrapped"):
        JsonlLog(tmp_path / f"{name}.jsonl").append({"key": "one", "date": "2026-01-02", "revision": "abc"})
    write_documents([Counting(), Bootstrapped()], tmp_path, tmp_path)
    _, counting, bootstrapped = (tmp_path / "proofs.md").read_text().split("## ")
    assert "intervals: Wilson, 95 %. " in counting
    assert "intervals: bootstrap, 90 %. " in bootstrapped


def test_what_was_rendered_elsewhere_stays_in_its_place(tmp_path):
    class Elsewhere(Counting):
        name = "elsewhere"

    class Later(Counting):
        name = "later"

    page = tmp_path / "proofs.md"
    whole = "Its claim.\n\n| a | b |\n| --- | --- |\n| ## | 2 |\n\n### A part\n\n## no longer flown\n\nOld figures."
    page.write_text(f"{BEGIN_MARKER}\n\n## later\n\nold\n\n## elsewhere\n\n{whole}\n\n{END_MARKER}\n")
    for name in ("counting", "later"):
        JsonlLog(tmp_path / f"{name}.jsonl").append({"key": "one", "date": "2026-01-02", "revision": "abc"})
    for _ in range(2):
        write_documents([Counting(), Elsewhere(), Later()], tmp_path, tmp_path)
    text = page.read_text()
    kept, gone = whole.split("\n\n## no longer flown")
    assert f"\n\n## elsewhere\n\n{kept}\n\n## later\n\n" in text
    assert text.endswith(f"\n\n## no longer flown{gone}\n\n{END_MARKER}\n")
    assert [line for line in text.splitlines() if line.startswith("## ")] == [
        "## counting",
        "## elsewhere",
        "## later",
        "## no longer flown",
    ]
    assert text.count("1 counted") == 2
    assert "old" not in text


def test_a_page_without_markers_is_not_written_over(tmp_path):
    (tmp_path / "proofs.md").write_text("words of a person")
    with pytest.raises(ValueError, match="unpack"):
        write_documents([], tmp_path, tmp_path)
