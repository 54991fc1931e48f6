"""Results of tests are read from a JUnit report: several parameters count as their worst, and odd files are refused."""

import subprocess
import sys

import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.evidence.test_report import read_test_report, requirement_status

SOURCE = """
import pytest

@pytest.mark.parametrize("number", [0, 1])
def test_numbers(number):
    assert number == 0

def test_good():
    pass

@pytest.mark.skip
def test_skipped():
    pass

@pytest.fixture
def broken():
    raise ValueError

def test_set_up(broken):
    pass
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report that pytest wrote."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "test_source.py").write_text(SOURCE)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--junitxml=report.xml",
        "test_source.py",
    ]
    subprocess.run(command, cwd=folder, capture_output=True, check=False)
    return read_test_report(folder / "report.xml")


@pytest.mark.parametrize(
    ("test", "status"),
    [
        ("test_source.py:test_numbers", "failed"),
        ("test_source.py:test_good", "passed"),
        ("test_source.py:test_skipped", "skipped"),
        ("test_source.py:test_set_up", "failed"),
        ("test_source.py:test_other", "not in the report"),
    ],
)
def test_the_status_of_a_test_is_that_of_pytest(report, test, status):
    assert report.status(test) == status


def test_the_cases_of_a_test_are_counted(report):
    assert report.cases["test_source.py:test_numbers"] == 2


def test_the_start_of_the_tests_is_stated(report):
    assert report.began
    assert all(report.began)


def test_a_requirement_passes_only_if_all_of_its_tests_pass():
    assert requirement_status(["passed", "passed"]) == "passed"
    assert requirement_status(["passed", "failed", "skipped"]) == "failed"
    assert requirement_status(["passed", "skipped"]) == "incomplete"
    assert requirement_status(["passed", "not in the report"]) == "incomplete"
    assert requirement_status([]) == "incomplete"


@pytest.mark.parametrize(
    "content",
    [
        "",
        "<testsuites><testsuite/></testsuites>",
        "<html><testcase/></html>",
        "<testsuites>",
        '<!DOCTYPE a [<!ENTITY b "c">]><testsuites><testcase name="&b;"/></testsuites>',
    ],
)
def test_a_file_that_is_no_report_is_a_configuration_error(tmp_path, content):
    (tmp_path / "report.xml").write_text(content)
    with pytest.raises(ConfigurationError):
        read_test_report(tmp_path / "report.xml")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32"])
def test_a_report_in_another_encoding_is_refused(tmp_path, encoding):
    text = '<!DOCTYPE a [<!ENTITY b "c">]><testsuites><testcase name="&b;"/></testsuites>'
    (tmp_path / "report.xml").write_bytes(text.encode(encoding))
    with pytest.raises(ConfigurationError, match=r"not UTF-8|document type"):
        read_test_report(tmp_path / "report.xml")
