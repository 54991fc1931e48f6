"""Installs a wheel into a clean environment outside the checkout, and runs the programs of a new user."""

from __future__ import annotations

import platform
import time
from pathlib import Path

import msgspec

from tools.release.environments import ROOT, Environment, create_environment, run_program

PLANNER = "starter-135m"
"""Planner of the demonstration."""
MODEL_FILES = (PLANNER, "minilm-l6-v2-int8", "minilm-l6-v2-tokenizer")
"""Names of the model files that the demonstration needs; they are downloaded if the cache has none."""
IMPORTS = ("import dualbrain", "from dualbrain import SafetyFilter")
"""Statements whose time is measured."""
TIMES = 5
"""Number of processes that measure one time; the median is reported."""
DIGEST_PROGRAM = Path(__file__).with_name("filter_digest.py")


class Installation(msgspec.Struct, frozen=True, kw_only=True):
    """One set of requirements in an environment: number of packages, size [bytes], time of the installation [s]."""

    requirement: str
    packages: int
    size_bytes: int
    seconds: float


class CheckedInterpreter(msgspec.Struct, frozen=True, kw_only=True):
    """The results of one interpreter and the wheel that pip selects for it."""

    python: str
    wheel: str
    base: Installation
    everything: Installation
    import_seconds: dict[str, float]
    digest: str
    programs: dict[str, float]
    """Time of each program [s]."""


def check_installation(wheel: Path, interpreter: Path, folder: Path) -> tuple[CheckedInterpreter, Environment]:
    """Install `wheel` with and without extras into `folder`, and run each program; raises `ProgramError`."""
    environment = create_environment(folder / "environment", interpreter)
    base = _install(environment, wheel, "")
    imports = {statement: import_seconds(environment, statement) for statement in IMPORTS}
    digest = run_program([environment.python, DIGEST_PROGRAM], cwd=folder).strip()
    programs = {"five-line filter": _time_example(environment, folder, "02_filter_five_lines")}
    everything = _install(environment, wheel, "[all]")
    programs |= _run_programs(environment, folder)
    version = run_program([environment.python, "-c", "import platform; print(platform.python_version())"]).strip()
    found = CheckedInterpreter(
        python=version,
        wheel=wheel.name,
        base=base,
        everything=everything,
        import_seconds=imports,
        digest=digest,
        programs=programs,
    )
    return found, environment


def import_seconds(environment: Environment, statement: str) -> float:
    """Median time of an import `statement` in a fresh process [s], without the start of the interpreter."""
    code = f"import time; begun = time.perf_counter(); {statement}; print(time.perf_counter() - begun)"
    times = sorted(float(run_program([environment.python, "-c", code], cwd=environment.folder)) for _ in range(TIMES))
    return times[TIMES // 2]


def _install(environment: Environment, wheel: Path, extras: str) -> Installation:
    seconds = environment.install(f"dualbrain{extras} @ {wheel.resolve().as_uri()}")
    others = [name for name in environment.packages() if name != "dualbrain"]
    return Installation(
        requirement=f"dualbrain{extras}",
        packages=len(others),
        size_bytes=environment.size_bytes(),
        seconds=seconds,
    )


def _run_programs(environment: Environment, folder: Path) -> dict[str, float]:
    """Run doctor, a scripted contract and the demonstration, each with a data folder of this check."""
    program = environment.program("dualbrain")
    home = {"DUALBRAIN_HOME": str(folder / "home")}
    run_program([program, "models", "fetch", *MODEL_FILES], cwd=folder, settings=home)
    commands = {
        "doctor": [program, "doctor"],
        "scripted contract": [environment.python, ROOT / "examples" / "03_run_a_contract.py"],
        "demonstration": [program, "demo", "--headless", "--planner", PLANNER, "--out", folder / "demo"],
    }
    return {name: _time(command, folder, home) for name, command in commands.items()}


def _time_example(environment: Environment, folder: Path, name: str) -> float:
    return _time([environment.python, ROOT / "examples" / f"{name}.py"], folder, {})


def _time(command: list[str | Path], folder: Path, settings: dict[str, str]) -> float:
    begun = time.perf_counter()
    run_program(command, cwd=folder, settings=settings)
    return time.perf_counter() - begun


def system_name() -> str:
    """Name and C library of the operating system."""
    release = platform.freedesktop_os_release().get("PRETTY_NAME", platform.system())
    return f"{release}, {' '.join(platform.libc_ver())}"
