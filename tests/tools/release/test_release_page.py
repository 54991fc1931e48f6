"""The page of a release check shows every interpreter, and whether the kernel bits are equal."""

import msgspec

from dualbrain import load_robot
from tools.release.filter_digest import ROBOTS, digest, random_calls
from tools.release.installation_check import IMPORTS, CheckedInterpreter, Installation
from tools.release.release_page import ReleaseReport, render_page

BASE = Installation(requirement="dualbrain", packages=4, size_bytes=80_000_000, seconds=3.0)
CHECKED = CheckedInterpreter(
    python="3.11.7",
    wheel="dualbrain-cp311.whl",
    base=BASE,
    everything=msgspec.structs.replace(BASE, requirement="dualbrain[all]", size_bytes=1_500_000_000),
    import_seconds=dict.fromkeys(IMPORTS, 0.0123),
    digest="ab" * 32,
    programs={"doctor": 2.5},
)
REPORT = ReleaseReport(
    date="2026-11-27",
    revision="0123456789ab",
    machine="2 cores",
    system="Debian",
    files={"dualbrain.tar.gz": 10_900_000},
    checked=(CHECKED, msgspec.structs.replace(CHECKED, python="3.12.1")),
    runners=("uv tool run --from WHEEL dualbrain --version",),
    specification="1.6",
    packages=95,
    models=6,
)


def test_the_page_has_a_row_for_every_measurement():
    page = render_page(REPORT)
    for row in (
        "| `dualbrain.tar.gz` | 10.9 MB |",
        "| 3.11.7 | `dualbrain` | 4 | 80.0 MB | 3 s |",
        "| 3.12.1 | `dualbrain[all]` | 4 | 1.50 GB | 3 s |",
        "| 3.11.7 | 12 ms | 12 ms |",
        "| 3.12.1 | 2.5 s |",
        "The digests are equal.",
        "2026-11-27, revision 0123456789ab",
    ):
        assert row in page


def test_different_bits_are_reported():
    other = msgspec.structs.replace(CHECKED, digest="cd" * 32)
    report = msgspec.structs.replace(REPORT, checked=(CHECKED, other))
    assert not report.has_equal_digests
    assert "The digests are DIFFERENT." in render_page(report)


def test_the_digest_covers_every_call_and_is_reproducible():
    assert digest(30) == digest(30) != digest(33)


def test_the_random_calls_exercise_the_filter_of_every_robot():
    for name in ROBOTS:
        robot = load_robot(name)
        statuses = {part[8 * robot.n :] for part in random_calls(robot, 150)}
        assert {b"MODIFIED", b"RELAXED", b"FAULT"} <= statuses
