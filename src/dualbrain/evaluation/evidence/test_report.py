"""Results of tests from a report in the JUnit XML format, as `pytest --junitxml` writes it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import ConfigurationError

MAX_REPORT_BYTES = 64 * 2**20
TestStatus = Literal["passed", "failed", "skipped", "not in the report"]
RequirementStatus = Literal["passed", "failed", "incomplete", "no test report", "not applicable"]


@dataclass(frozen=True, slots=True)
class TestReport:
    """Status and number of cases of each test by its name "FILE:FUNCTION", and the times at which its suites began."""

    __test__ = False
    statuses: dict[str, TestStatus]
    began: tuple[str, ...]
    cases: dict[str, int] = field(default_factory=dict)

    def status(self, test: str) -> TestStatus:
        """The status of one test; with several parameters the worst of them."""
        return self.statuses.get(test, "not in the report")


def read_test_report(path: Path) -> TestReport:
    """The report in the file `path`.

    Raises:
        ConfigurationError: The file does not exist, is too large, or is no report in this format.
    """
    content = read_regular_file(path, MAX_REPORT_BYTES)
    if isinstance(content, FileRefusal):
        raise ConfigurationError.stating(f"--tests: {content.sentence}", fix=content.fix)
    fix = "Write it with `pytest --junitxml FILE`, or with `make evidence`."
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigurationError.stating(f"The test report {path} (--tests) is not UTF-8.", fix=fix) from error
    if "\0" in text or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigurationError.stating(f"The test report {path} (--tests) declares a document type.", fix=fix)
    try:
        root = ElementTree.fromstring(text.partition("?>")[2] if text.startswith("<?xml") else text)
    except ElementTree.ParseError as error:
        raise ConfigurationError.stating(f"The test report {path} (--tests) is no XML: {error}.", fix=fix) from error
    cases = list(root.iter("testcase"))
    if root.tag not in ("testsuites", "testsuite") or not cases:
        raise ConfigurationError.stating(
            f"The file {path} (--tests) contains no test results in the JUnit format.", fix=fix
        )
    found: defaultdict[str, list[TestStatus]] = defaultdict(list)
    for case in cases:
        found[_test_name(case)].append(_case_status(case))
    began = tuple(suite.get("timestamp", "") for suite in root.iter("testsuite"))
    counts = {name: len(statuses) for name, statuses in found.items()}
    return TestReport({name: _worst(statuses) for name, statuses in found.items()}, began, counts)


def requirement_status(statuses: Iterable[TestStatus]) -> RequirementStatus:
    """Status of a requirement: passed if every test passed, failed if one failed, otherwise incomplete."""
    found = set(statuses)
    if "failed" in found:
        return "failed"
    return "passed" if found == {"passed"} else "incomplete"


def _test_name(case: ElementTree.Element) -> str:
    """FILE:FUNCTION of a test case; pytest writes the module as class name, and parameters after "["."""
    file = case.get("classname", "").replace(".", "/") + ".py"
    return f"{file}:{case.get('name', '').partition('[')[0]}"


def _case_status(case: ElementTree.Element) -> TestStatus:
    tags = {child.tag for child in case}
    if tags & {"failure", "error"}:
        return "failed"
    return "skipped" if "skipped" in tags else "passed"


def _worst(statuses: list[TestStatus]) -> TestStatus:
    order: tuple[TestStatus, ...] = ("failed", "skipped", "passed")
    return next(status for status in order if status in statuses)
