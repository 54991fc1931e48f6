"""The analyses: Frama-C Eva, cppcheck with its MISRA addon, libFuzzer. Each returns its findings as JSON values."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.instruction_counts.robot_table import robot_table
from tools.kernel_limits.compiled import ROOT, shipped_flags

HARNESSES = ROOT / "tests/static_analysis/harnesses"
KERNEL = ROOT / "kernel/src"
SMALL = ("-DDBK_LANES=1", "-DDBK_MAX_OBSTACLES=128", "-DDBK_MAX_ROWS=64", "-DDBK_MAX_REVISITS=64")
"""Capacities of the complete step in Eva. The index of a row is of a sphere or of an obstacle: there are no fewer
obstacles than spheres."""
EVA = ("frama-c", "-eva", "-warn-special-float", "none", "-machdep", "gcc_x86_64", "-eva-no-show-progress")
FUZZ_SECONDS = 60


def includes(folder: Path) -> list[str]:
    """Include folders of the harnesses; `folder` receives the table of the robot."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot_table.h").write_text(robot_table("panda"))
    places = (ROOT / "kernel/include", KERNEL, ROOT / "tools/instruction_counts", HARNESSES, folder)
    return [f"-I{place}" for place in places]


def step_sources() -> list[str]:
    """The sources of a step; the inverse dynamics of the grippers are no part of it."""
    return sorted(str(path) for path in KERNEL.rglob("*.c") if path.parent.name != "dynamics")


def verify_output(folder: Path) -> dict[str, Any]:
    """Eva: the output function of every step."""
    sources = [str(HARNESSES / "eva_output.c"), str(KERNEL / "qp/dbk_intervention.c")]
    return run_eva(folder, ["-eva-precision", "2"], ["-DDBK_LANES=1", "-DDBK_MAX_OBSTACLES=4"], sources)


def analyse_step(folder: Path) -> dict[str, Any]:
    """Eva: the complete step of the Panda in arbitrary scenes; more than an hour.

    Local arrays count as initialised: Eva does not relate the count of the loop that fills an array to that of the loop
    that reads it. The memory sanitizer and the builds with patterns in `tests/kernel` test their initialisation.
    """
    options = ["-eva-precision", "1", "-eva-initialized-locals"]
    return run_eva(folder, options, list(SMALL), [str(HARNESSES / "eva_step.c"), *step_sources()])


def analyse_supervisor(folder: Path) -> dict[str, Any]:
    """Eva: the state machine of the supervisor and the enforcement of its decisions."""
    parts = ("supervisor", "standstill", "checks")
    sources = [str(ROOT / f"kernel/supervisor/dbk_{part}.c") for part in parts]
    return run_eva(folder, ["-eva-precision", "2"], [], [str(HARNESSES / "eva_supervisor.c"), *sources])


def run_eva(folder: Path, options: list[str], macros: list[str], sources: list[str]) -> dict[str, Any]:
    """Alarms by kind, and proven and unproven assertions."""
    flags = " ".join([*macros, *includes(folder)])
    done = subprocess.run(
        [*EVA, *options, f"-cpp-extra-args={flags}", *sources], cwd=ROOT, capture_output=True, text=True, check=True
    )
    summary = done.stdout[done.stdout.rindex("ANALYSIS SUMMARY") :]
    kinds = re.findall(r"^ {5,}(\d+) (.+)$", summary.split("alarm")[1].split("Evaluation")[0], re.M)
    total = re.search(r"(\d+) alarms? generated", summary)
    assertions = re.search(r"Assertions +(\d+) valid +(\d+) unknown +(\d+) invalid", summary)
    assert total is not None, summary
    assert assertions is not None, summary
    return {
        "alarms": int(total.group(1)),
        "kinds": {name: int(count) for count, name in kinds},
        "assertions": dict(zip(("valid", "unknown", "invalid"), map(int, assertions.groups()), strict=True)),
    }


def check_misra(folder: Path) -> dict[str, Any]:
    """Cppcheck with the MISRA addon: number of notes by rule, and the other findings."""
    done = subprocess.run(
        ["cppcheck", "--addon=misra", "--std=c99", "--enable=warning,style,performance,portability", "--quiet",
         "--suppress=missingIncludeSystem", "--template={id} {file}:{line}", "-DDBK_MAX_OBSTACLES=48",
         *includes(folder), str(KERNEL)],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    notes = {line for line in done.stderr.splitlines() if " " in line}
    rules = Counter(note.split()[0].removeprefix("misra-c2012-") for note in notes if note.startswith("misra"))
    others = sorted(note.replace(f"{ROOT}/", "") for note in notes if not note.startswith("misra"))
    return {"rules": dict(rules.most_common()), "others": others}


def fuzz_step(folder: Path) -> dict[str, Any]:
    """LibFuzzer with the address and undefined-behaviour sanitizers; a finding raises an error."""
    return run_fuzzer(folder, "address,undefined")


def fuzz_initialisation(folder: Path) -> dict[str, Any]:
    """LibFuzzer with the memory sanitizer: a branch, an address or a result that depends on an unset value."""
    return run_fuzzer(folder, "memory")


def run_fuzzer(folder: Path, sanitizers: str) -> dict[str, Any]:
    """Sequences of steps from arbitrary bytes under `sanitizers`; a finding raises an error."""
    program, corpus = folder / "fuzz_step", folder / "corpus"
    arguments = includes(folder)
    corpus.mkdir(exist_ok=True)
    flags = [flag for flag in shipped_flags() if not flag.startswith("-O") and "slp" not in flag]
    sanitize = [f"-fsanitize=fuzzer,{sanitizers}", "-fno-sanitize-recover=all"]
    subprocess.run(
        ["clang", "-O1", "-g", *sanitize, *flags, "-DDBK_LANES=1", "-DDBK_MAX_OBSTACLES=48", *arguments,
         str(HARNESSES / "fuzz_step.c"), *step_sources(), "-o", str(program)],
        check=True,
    )  # fmt: skip
    limits = [f"-max_total_time={FUZZ_SECONDS}", "-max_len=4096", "-seed=1", f"-artifact_prefix={folder}/"]
    done = subprocess.run([str(program), *limits, str(corpus)], capture_output=True, text=True, check=True)
    ran = re.search(r"Done (\d+) runs", done.stderr)
    assert ran is not None, done.stderr
    return {"sequences": int(ran.group(1)), "seconds": FUZZ_SECONDS, "findings": 0}


CHECKS: dict[str, tuple[str, Callable[[Path], dict[str, Any]]]] = {
    "output": ("frama-c", verify_output),
    "step": ("frama-c", analyse_step),
    "supervisor": ("frama-c", analyse_supervisor),
    "misra": ("cppcheck", check_misra),
    "fuzz": ("clang", fuzz_step),
    "initialisation": ("clang", fuzz_initialisation),
}
"""Program and function of every analysis by name."""


def missing_programs() -> list[str]:
    """Programs that are not installed."""
    return sorted({program for program, _ in CHECKS.values() if shutil.which(program) is None})
