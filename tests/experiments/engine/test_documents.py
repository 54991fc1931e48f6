"""Pages of experiments: hand-written text stays, everything below the marker line comes from the log."""

import pytest

from dualbrain.core.storage.jsonl_log import JsonlLog
from experiments.engine import documents
from experiments.engine.documents import INDEX_MARKER, MARKER, page_path, write_index, write_pages

ROW = {"key": "one", "date": "2026-01-02", "revision": "abc", "load": 1.0, "wall_s": 3600.0}


class Counting:
    name, claim = "counting", "One comes before two."

    def report(self, rows):
        return [f"{len(rows)} counted"]


class Bootstrapped(Counting):
    name, intervals = "bootstrapped", "bootstrap, 90 %"


class Elsewhere(Counting):
    """An experiment without a log on this machine."""

    name = "elsewhere"


def log(folder, name, *rows):
    for row in rows:
        JsonlLog(folder / f"{name}.jsonl").append(row)


def test_a_page_keeps_its_text_and_gets_new_tables(tmp_path):
    page = page_path(Counting(), tmp_path)
    page.parent.mkdir(parents=True)
    page.write_text(f"# Counting\n\nHow it is done.\n\n{MARKER}\n\nold\n")
    log(tmp_path, "counting", ROW, {**ROW, "key": "two"}, {"key": "three", "error": "broke"})
    write_pages([Counting()], tmp_path, tmp_path)
    once = page.read_text()
    write_pages([Counting()], tmp_path, tmp_path)
    assert page.read_text() == once
    assert once.startswith(f"# Counting\n\nHow it is done.\n\n{MARKER}\n\n**Claim.** One comes before two.\n")
    assert once.endswith("\n## Results\n\n2 counted\n")
    assert "| date | 2026-01-02 |\n| units | 2 |\n| revision | abc (2) |\n" in once
    assert "| worker time | 2.0 h, median load 1.0 |\n| intervals | Wilson, 95 % |\n" in once
    assert "old" not in once


def test_a_new_page_gets_a_title(tmp_path):
    log(tmp_path, "bootstrapped", ROW)
    write_pages([Bootstrapped()], tmp_path, tmp_path)
    text = page_path(Bootstrapped(), tmp_path).read_text()
    assert text.startswith(f"# Bootstrapped\n\n{MARKER}\n")
    assert "| intervals | bootstrap, 90 % |" in text


def test_the_machine_is_that_of_the_rows_or_of_the_page(tmp_path):
    page = page_path(Counting(), tmp_path)
    log(tmp_path, "counting", ROW)
    write_pages([Counting()], tmp_path, tmp_path)
    assert "| machine | not recorded |" in page.read_text()
    page.write_text(page.read_text().replace("not recorded", "one old core"))
    write_pages([Counting()], tmp_path, tmp_path)
    assert "| machine | one old core |" in page.read_text()
    log(tmp_path, "counting", {**ROW, "key": "two", "revision": "abc+123", "machine": "two new cores"})
    write_pages([Counting()], tmp_path, tmp_path)
    assert "| machine | one old core; two new cores |" in page.read_text()
    assert "| revision | abc (1), abc+123 (1) (+: with uncommitted changes) |" in page.read_text()


def test_a_plot_is_drawn_and_shown(tmp_path, monkeypatch):
    monkeypatch.setitem(documents.PLOTS, "counting", ("How many", lambda rows, path: path.write_bytes(b"PNG")))
    log(tmp_path, "counting", ROW)
    write_pages([Counting()], tmp_path, tmp_path)
    assert (tmp_path / "images" / "counting.png").read_bytes() == b"PNG"
    assert "![How many](../../images/counting.png)\n\n1 counted" in page_path(Counting(), tmp_path).read_text()


def test_a_page_without_a_log_stays_as_it_is(tmp_path):
    page = page_path(Elsewhere(), tmp_path)
    page.parent.mkdir(parents=True)
    page.write_text("written where its log is")
    log(tmp_path, "elsewhere", {"key": "one", "error": "broke"})
    write_pages([Elsewhere()], tmp_path, tmp_path)
    assert page.read_text() == "written where its log is"


def test_a_page_without_its_marker_is_not_overwritten(tmp_path):
    page = page_path(Counting(), tmp_path)
    page.parent.mkdir(parents=True)
    page.write_text("hand-written text")
    log(tmp_path, "counting", ROW)
    with pytest.raises(ValueError, match="must contain this line exactly once"):
        write_pages([Counting()], tmp_path, tmp_path)
    assert page.read_text() == "hand-written text"


def test_the_index_lists_the_pages_that_exist(tmp_path):
    (tmp_path / "experiments").mkdir()
    index = tmp_path / "experiments" / "README.md"
    index.write_text(f"# Experiments\n\n{INDEX_MARKER}\n\nold\n")
    log(tmp_path, "counting", ROW)
    write_pages([Counting()], tmp_path, tmp_path)
    for _ in range(2):
        write_index([Counting(), Elsewhere()], tmp_path)
    group = page_path(Counting(), tmp_path).parent.name
    assert index.read_text() == (
        f"# Experiments\n\n{INDEX_MARKER}\n\n| experiment | claim |\n| --- | --- |\n"
        f"| [`counting`]({group}/counting.md) | One comes before two. |\n"
    )
