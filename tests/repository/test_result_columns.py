"""The page of result columns: every column with its type, and queries that agree with the package's own reader."""

import re
from pathlib import Path

import duckdb
import msgspec
import pytest

from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.results.parquet import read_results, write_results
from tests.evaluation.sample_rows import episode_row

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "result_columns.md").read_text("utf-8")
RESULTS = ROOT / "docs" / "results" / "paper" / "results.parquet"
QUERIES = re.findall(r"```sql\n(.*?)```", PAGE, re.DOTALL)
TYPES = {
    "text": "VARCHAR",
    "JSON": "VARCHAR",
    "integer": "BIGINT",
    "number": "DOUBLE",
    "boolean": "BOOLEAN",
    "list of numbers": "DOUBLE[]",
}


@pytest.fixture(scope="module")
def answers():
    """The rows that each query of the page gives for the committed results, as dictionaries."""
    found = []
    for query in QUERIES:
        result = duckdb.execute(query.replace("'results.parquet'", f"'{RESULTS}'"))
        names = [name for name, *_ in result.description]
        found.append([dict(zip(names, row, strict=True)) for row in result.fetchall()])
    return found


@pytest.fixture(scope="module")
def rows():
    return read_results(RESULTS)[0]


def share(values):
    values = list(values)
    return sum(values) / len(values)


def test_the_page_has_every_column_in_order_with_its_type(tmp_path):
    write_results([episode_row()], {}, tmp_path / "results.parquet")
    written = duckdb.execute(f"DESCRIBE SELECT * FROM '{tmp_path / 'results.parquet'}'").fetchall()
    listed = re.findall(r"^\| `(\w+)` \| ([\w ]+) \| .+ \|$", PAGE, re.MULTILINE)
    assert {name: TYPES[kind] for name, kind in listed} == {name: kind for name, kind, *_ in written}
    assert {name for name, _ in listed} == {one.name for one in msgspec.structs.fields(EpisodeRow)}
    assert len(listed) == len(written)
    structured = {one.name for one in msgspec.structs.fields(EpisodeRow) if one.type is not str}
    assert {name for name, kind in listed if kind == "JSON"} - {"contract"} <= structured


def test_the_page_has_five_queries_and_each_has_an_answer(answers):
    assert len(answers) == 5
    assert all(answers)


def test_success_and_violations_by_method_are_those_of_the_reader(answers, rows):
    for found in answers[0]:
        own = [row for row in rows if row.method == found["method"]]
        assert found["episodes"] == len(own)
        assert found["success"] == pytest.approx(share(row.success for row in own))
        assert found["with_violation"] == pytest.approx(share(bool(row.violations) for row in own))


def test_pairs_are_those_of_the_reader(answers, rows):
    success = {(row.method, row.pair): row.success for row in rows}
    for found in answers[1]:
        pairs = [row.pair for row in rows if row.method == "B1" and row.task == found["task"]]
        assert found["pairs"] == len(pairs)
        differences = [success["B3", pair] - success["B1", pair] for pair in pairs]
        assert found["difference"] == pytest.approx(share(differences))


def test_violations_by_kind_are_those_of_the_reader(answers, rows):
    expected = {}
    for row in rows:
        for violation in row.violations:
            count, peak = expected.get((row.method, violation.kind), (0, 0.0))
            expected[row.method, violation.kind] = (count + 1, max(peak, violation.peak))
    found = {(one["method"], one["kind"]): (one["violations"], one["peak"]) for one in answers[2]}
    assert found == expected


def test_decision_times_and_quarters_are_those_of_the_reader(answers, rows):
    for found in answers[3]:
        times = sorted(row.planner_s for row in rows if row.asked and row.planner == found["planner"])
        assert found["answers"] == len(times)
        assert times[0] <= found["seconds"][0] <= found["seconds"][1] <= times[-1]
    for method in ("B4", "M"):
        quarters = [one for one in answers[4] if one["method"] == method]
        assert [one["quarter"] for one in quarters] == [1, 2, 3, 4]
        own = [row for row in rows if row.method == method]
        first = [row for row in own if row.order < len([one for one in own if one.cluster == row.cluster]) / 4]
        assert share(row.success for row in first) == pytest.approx(quarters[0]["success"], abs=0.1)
