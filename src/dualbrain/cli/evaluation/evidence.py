"""dualbrain evidence: the evidence folder for a safety engineer."""

from __future__ import annotations

import time
from pathlib import Path

from dualbrain.cli.common.console import StderrConsole, print_message, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.spinner import Spinner
from dualbrain.core.text import count_noun


def write(
    robot: str = "panda",
    /,
    *,
    out: Path,
    site: Path | None = None,
    tests: Path | None = None,
    run: tuple[Path, ...] = (),
    commissioned: Path | None = None,
    driver: str = "",
) -> int:
    """Write the evidence for a robot at a site into one folder.

    The folder contains the hazard log, the requirements with their tests and results, every limit with its provenance,
    measured figures with their revisions, a bill of materials with the model files, and replay instructions; as
    Markdown, as one HTML page, and with a manifest of SHA-256. It is no certificate and no risk assessment.

    Example: `dualbrain evidence write panda --site lab.toml --tests report.xml --run runs/a --out evidence`. In a
    checkout, `make evidence ROBOT=panda SITE=lab.toml` runs the tests first.

    Exit code 0: written; 1: written, and a requirement failed or a run was not recomputed identically.

    Parameters
    ----------
    robot
        A name, or a folder made by `dualbrain robot init`.
    out
        The folder to write; it must not contain files.
    site
        Site file of the installation (TOML).
    tests
        Test report in the JUnit format, from `pytest --junitxml FILE` in a checkout of this version.
    run
        Folder of a recorded run, which is recomputed; may be repeated.
    commissioned
        Commissioning record, checked against robot model, site file and driver; needs --site and --driver.
    driver
        Driver of the commissioning record: franka or ur; needs --commissioned.
    """
    from dualbrain.evaluation.evidence.evidence_folder import write_evidence
    from dualbrain.evaluation.evidence.subject import EvidenceInputs
    from dualbrain.visualization.html.evidence_page import render_evidence_page

    inputs = EvidenceInputs(
        robot=robot, site=site, test_report=tests, runs=run, commissioned=commissioned, driver=driver
    )
    with Spinner(StderrConsole(), "collecting the evidence; the list of installed packages takes about 20 s"):
        summary = write_evidence(inputs, out, now=time.time(), render=render_evidence_page)
    for state, count in summary.statuses.items():
        print_message(f"{count_noun(count, 'requirement')}: {state}")
    for recording in summary.differing_runs:
        print_message(f"not identical: {recording}")
    print_message(f"evidence: {out / 'evidence.html'}, SHA-256 of the manifest {summary.manifest_sha256}")
    failed = summary.statuses.get("failed", 0) or summary.differing_runs
    return ExitCode.FAILED_SAFELY if failed else ExitCode.SUCCESS


def verify(folder: Path, /) -> int:
    """Compare an evidence folder with its manifest. Exit code 0: unchanged; 1: a file differs.

    Parameters
    ----------
    folder
        Folder that `dualbrain evidence write` wrote.
    """
    from dualbrain.core.storage.checksum import file_sha256
    from dualbrain.evaluation.evidence.evidence_folder import MANIFEST_FILE, changed_files

    changed = changed_files(folder)
    for name in changed:
        print_message(f"changed, missing or added: {name}")
    if not changed:
        print_message(f"unchanged; SHA-256 of the manifest {file_sha256(folder / MANIFEST_FILE)}")
    return ExitCode.FAILED_SAFELY if changed else ExitCode.SUCCESS


def list_tests() -> int:
    """Print the tests of the requirements, one per line, as arguments for pytest."""
    from dualbrain.evaluation.evidence.requirement import required_tests

    for test in required_tests():
        print_result(test.replace(":", "::"))
    return ExitCode.SUCCESS
