"""Committed pages are those of their tables, and keep what the tables do not contain."""

import pytest

from tools.results.refresh_pages import IMAGE, RESULTS, captions, decision_latencies, refreshed_page, report_data


@pytest.mark.parametrize("suite", ["eyes", "attacks"])
def test_a_committed_page_is_that_of_its_table(suite):
    page = (RESULTS / suite / "report.md").read_text(encoding="utf-8")
    assert refreshed_page(report_data(RESULTS / suite), page) == page


def test_every_page_keeps_its_images_traces_and_decision_times():
    for page in RESULTS.glob("*/report.md"):
        text = page.read_text(encoding="utf-8")
        shown = [page.parent / name for name in ("curves.svg", "traces.svg", "latencies.svg")]
        shown += [page.parent / f"failure_{k + 1}.jpg" for k in range(len(IMAGE.findall(text)))]
        assert all(one.is_file() and f"({one.name})" in text for one in shown)
        assert sorted(page.parent.glob("*.jpg")) == sorted(one for one in shown if one.suffix == ".jpg")


def test_parts_of_a_page_are_read():
    data, page = report_data(RESULTS / "eyes"), (RESULTS / "eyes" / "report.md").read_text(encoding="utf-8")
    found = captions(data.rows, page)
    assert [row.key for row, _ in found][:2] == ["B3 panda fragile_transfer II 40011 r1 #0", IMAGE.findall(page)[1][1]]
    assert decision_latencies(page).rows == (("transformers:base-135m", "120", "4.25", "8.53", "120", "3.09"),)
    assert decision_latencies("# A page without answers\n").rows == ()
