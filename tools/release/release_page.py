"""The page of a release check: files, installations, programs, digests, SBOM."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from tools.release.filter_digest import CALLS
from tools.release.installation_check import IMPORTS, CheckedInterpreter

PAGE = """\
# Release check

Results of `make release-check`: the distributions are built from the checkout, repaired, checked, and installed into
clean environments outside the checkout. {date}, revision {revision}, {machine}, {system}.

The command needs CPython 3.11, 3.12 and 3.13 (on `PATH`, of pyenv, or of uv; `ALLOW_MISSING=1` checks those that are
there), and 3 GB in the temporary folder. `dist/` then contains the files to publish and the SBOM.

## Files

The wheels are built from the source distribution. The wheel for CPython 3.11 is compiled by gcc; the other one is
compiled by zig for the stable ABI, so that one file serves CPython 3.12 and newer.

{files}

## Installations

With the versions of `constraints.txt` and the download cache of pip. Packages: all that pip installs besides dualbrain.

{installations}

## Import time

Median of five fresh processes, without the start of the interpreter.

{imports}

## Programs

Time of each program in the environment of `dualbrain[all]`, of the filter in that of `dualbrain`. The demonstration
runs headless with the planner `starter-135m`.

{programs}

## Kernel bits

SHA-256 of the controls and states of {calls} random filter calls (Panda, UR5e, mobile Panda), which
`tools/release/filter_digest.py` prints. {verdict}

{digests}

## Runners and SBOM

The commands {runners} print the version.

The SBOM (CycloneDX {specification}, `dualbrain.cdx.json`) lists {packages} packages of `dualbrain[all]` and {models}
model files with SHA-256, licence and source.
"""


class ReleaseReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a release check found: sizes of files [bytes], interpreters, runners, components of the SBOM."""

    date: str
    revision: str
    machine: str
    system: str
    files: dict[str, int]
    checked: tuple[CheckedInterpreter, ...]
    runners: tuple[str, ...]
    specification: str
    packages: int
    models: int

    @property
    def has_equal_digests(self) -> bool:
        """Whether all wheels computed the same bits."""
        return len({one.digest for one in self.checked}) <= 1


def render_page(report: ReleaseReport) -> str:
    """The page in Markdown."""
    return PAGE.format(
        date=report.date,
        revision=report.revision,
        machine=report.machine,
        system=report.system,
        files=_table(("file", "size"), ((f"`{name}`", _megabytes(size)) for name, size in report.files.items())),
        installations=_installations(report.checked),
        imports=_table(
            ("Python", *(f"`{statement}`" for statement in IMPORTS)),
            ((one.python, *(f"{one.import_seconds[name] * 1e3:.0f} ms" for name in IMPORTS)) for one in report.checked),
        ),
        programs=_programs(report.checked),
        calls=CALLS,
        verdict=f"The digests are {'equal' if report.has_equal_digests else 'DIFFERENT'}.",
        digests=_table(
            ("Python", "wheel", "SHA-256"),
            ((one.python, f"`{one.wheel}`", f"`{one.digest}`") for one in report.checked),
        ),
        runners=" and ".join(f"`{runner}`" for runner in report.runners),
        specification=report.specification,
        packages=report.packages,
        models=report.models,
    )


def _installations(checked: Iterable[CheckedInterpreter]) -> str:
    rows = [
        (one.python, f"`{part.requirement}`", str(part.packages), _megabytes(part.size_bytes), f"{part.seconds:.0f} s")
        for one in checked
        for part in (one.base, one.everything)
    ]
    return _table(("Python", "installation", "packages", "disk", "time"), rows)


def _programs(checked: tuple[CheckedInterpreter, ...]) -> str:
    names = checked[0].programs if checked else ()
    rows = ((one.python, *(f"{one.programs[name]:.1f} s" for name in names)) for one in checked)
    return _table(("Python", *names), rows)


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = tuple(heads)
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _megabytes(size: int) -> str:
    """A size [bytes] in units of 10^6 bytes."""
    return f"{size / 1e6:.1f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"
