"""Release check: builds the distributions, checks them, and uses them as a new user does.

    python -m tools.release [--out dist] [--allow-missing] [--reuse-distributions] [--write-docs]

Source distribution, a wheel for CPython 3.11 (gcc) and one for the stable ABI from 3.12 (zig); twine,
check-wheel-contents and abi3audit; clean installations on 3.11, 3.12 and 3.13, each with `dualbrain doctor`, the
filter in five lines, a scripted contract and the demonstration; equal kernel bits; uv and pipx; the SBOM. The exit code
is 1 if anything fails, 2 if an interpreter is missing.
"""

from __future__ import annotations

import argparse
import datetime
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path

from dualbrain.core.weights import MANIFEST
from dualbrain.evaluation.runner.provenance import git_revision, machine_description
from tools.release.distribution_checks import check_files
from tools.release.distributions import Distributions, build_distributions, find_distributions
from tools.release.environments import ROOT, Environment, ProgramError, create_environment
from tools.release.installation_check import CheckedInterpreter, check_installation, system_name
from tools.release.interpreters import MissingInterpreterError, find_interpreters
from tools.release.program_runners import WrongVersionError, check_runners
from tools.release.release_page import ReleaseReport, render_page
from tools.release.sbom import SPECIFICATION, write_sbom

SOURCES = ("src", "kernel", "firmware")
"""Folders that a wheel is built from; changes in other folders are not part of the revision."""
PAGE = ROOT / "docs" / "reference" / "verification" / "release.md"


def main() -> int:
    """Return 0 if the release can be published, 1 if a check failed, 2 if an interpreter is missing."""
    options = parse(sys.argv[1:])
    try:
        interpreters = find_interpreters(allow_missing=options.allow_missing)
        with tempfile.TemporaryDirectory(prefix="dualbrain-release-") as work:
            report, problems = check_release(
                options.out.resolve(), Path(work), interpreters, options.reuse_distributions
            )
    except MissingInterpreterError as error:
        sys.stderr.write(f"{error} Or pass --allow-missing to check the others.\n")
        return 2
    except (ProgramError, WrongVersionError, FileNotFoundError) as error:
        sys.stderr.write(f"release check failed: {error}\n")
        return 1
    page = render_page(report)
    sys.stdout.write(page)
    if options.write_docs:
        PAGE.write_text(page, "utf-8")
    for problem in problems:
        sys.stderr.write(f"release check failed: {problem}\n")
    return int(bool(problems))


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the files (default: dist)")
    parser.add_argument("--allow-missing", action="store_true", help="check without the interpreters that are missing")
    parser.add_argument("--reuse-distributions", action="store_true", help="check the files that are in --out already")
    parser.add_argument("--write-docs", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    return parser.parse_args(arguments)


def check_release(
    out: Path, work: Path, interpreters: Mapping[str, Path], reuse: bool
) -> tuple[ReleaseReport, list[str]]:
    """The report, and the problems that no program reported by failing; raises `ProgramError`."""
    revision = git_revision(ROOT / "tools", SOURCES)
    tools = _release_tools(work / "tools")
    found = find_distributions(out) if reuse else _build(out, work, interpreters, tools)
    _announce("checking the files")
    problems = check_files(found, tools)
    checked, packages = _check_installations(found, work, interpreters, tools, out)
    version, interpreter = list(interpreters.items())[-1]
    _announce("running the program with uv and pipx")
    runners = check_runners(found.wheel_for(version), interpreter, _folder(work / "runners"), tools)
    report = ReleaseReport(
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        revision=revision,
        machine=machine_description(),
        system=system_name(),
        files={path.name: path.stat().st_size for path in found.files},
        checked=checked,
        runners=runners,
        specification=SPECIFICATION,
        packages=packages,
        models=len(MANIFEST),
    )
    if not report.has_equal_digests:
        problems.append("the wheels compute different controls: compare the digests above")
    return report, problems


def _release_tools(folder: Path) -> Environment:
    """An environment with the extra `release`."""
    _announce("installing the release tools")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    tools = create_environment(folder, Path(sys.executable))
    tools.install(*project["optional-dependencies"]["release"])
    return tools


def _build(out: Path, work: Path, interpreters: Mapping[str, Path], tools: Environment) -> Distributions:
    _announce("building the source distribution and the wheels")
    for old in _folder(out).glob("dualbrain*"):
        old.unlink()
    return build_distributions(out, _folder(work / "build"), interpreters, tools)


def _check_installations(
    found: Distributions, work: Path, interpreters: Mapping[str, Path], tools: Environment, out: Path
) -> tuple[tuple[CheckedInterpreter, ...], int]:
    """Check every interpreter, write the SBOM of the first one to `out`, and count its packages."""
    checked: list[CheckedInterpreter] = []
    packages = 0
    for version, interpreter in interpreters.items():
        _announce(f"installing and running on Python {version}")
        folder = _folder(work / f"python-{version}")
        one, environment = check_installation(found.wheel_for(version), interpreter, folder)
        if not checked:
            sbom = write_sbom(out / "dualbrain.cdx.json", environment, tools)
            packages = len(sbom["components"]) - len(MANIFEST)
        checked.append(one)
        shutil.rmtree(folder)  # 2 GB each
    return tuple(checked), packages


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _announce(step: str) -> None:
    sys.stderr.write(f"release check: {step}\n")


if __name__ == "__main__":
    raise SystemExit(main())
