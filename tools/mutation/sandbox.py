"""A copy of the project in which one file at a time is mutated, compiled and tested."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path

from tools.mutation.sampling import Mutant

COPIED_PATHS = (
    "kernel",
    "src",
    "tests",
    "vectors",
    "benchmarks",
    "experiments",
    "tools",
    "docs",
    "pyproject.toml",
    "CMakeLists.txt",
    "README.md",
    "LICENSE",
)
BUILD_TARGETS = ("_kernel", "_kernel64")
"""Compiled libraries; they have the same sources as the builds for more controls."""
STEP_TEST_NAMES = (
    "step_internals",
    "active_set",
    "numeric_limits",
    "model_upload",
    "relaxation_reference",
    "certificate",
)
STEP_TESTS = tuple(f"tests/safety/kernel_step/test_{name}.py" for name in STEP_TEST_NAMES)
"""Tests that run first, in a separate run of seconds: they compare all values of a step with their definitions."""
TESTS = ("tests/safety", "tests/invariants", "tests/kernel/test_buffer_capacity.py")
EXCLUDED_TESTS = (
    *(f"tests/safety/kernel/test_{name}.py" for name in ("step_vectors", "build_variants")),
    *(f"tests/safety/supervisor/test_{name}.py" for name in ("supervisor", "loop_delay")),
)
"""Recorded results and comparisons of builds, which detect every changed bit and test no property; tests of the
supervisor, which call no kernel; tests of the loop delay, which need builds that are not compiled here."""
STEP_TESTS_CPU_S, MIN_CPU_S, BASELINE_FACTOR = 30.0, 60.0, 5.0
"""Limits of processor time [s]: of the tests that run first, of the others; or a multiple of the unmutated run."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the tests: whether a fault was detected, how (`by`), by which `test`, and processor time [s]."""

    caught: bool
    by: str
    test: str
    seconds: float


class Sandbox:
    """A folder with sources, objects and tests; used by one thread at a time."""

    def __init__(self, root: Path, folder: Path, limit: float = MIN_CPU_S) -> None:
        """`limit`: largest processor time of one run of the tests [s], independent of other load on the machine."""
        self.root, self.folder, self.limit = root, folder, limit
        self._tools = Path(sys.executable).parent

    # --- set-up -----------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Copy all files that are tracked or not ignored, and compile them once."""
        self._copy()
        cmake_lists = self.folder / "CMakeLists.txt"
        # a changed source must not trigger a configuration, which would compile the binding again with a new hash
        cmake_lists.write_text(
            re.sub(r"^.*CMAKE_CONFIGURE_DEPENDS.*\n", "", cmake_lists.read_text(), flags=re.MULTILINE)
        )
        build = self.folder / "build"
        arguments = ["-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release", f"-DPython_EXECUTABLE={sys.executable}"]
        self._call([self._tool("cmake"), *arguments, "-S", str(self.folder), "-B", str(build)], check=True)
        self._call([self._tool("ninja"), "-C", str(build), *self._libraries()], check=True)
        self._install()
        self._original = self._objects()
        self._sources: dict[str, str] = {}

    def _copy(self) -> None:
        listing = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *COPIED_PATHS],
            cwd=self.root,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        names = {
            name for name in listing.split("\0") if name and not name.endswith(".so") and (self.root / name).is_file()
        }
        for old in (p for top in COPIED_PATHS for p in (self.folder / top).rglob("*") if p.is_file()):
            if str(old.relative_to(self.folder)) not in names:
                old.unlink()
        for name in names:
            target = self.folder / name
            if not target.exists() or target.read_bytes() != (self.root / name).read_bytes():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self.root / name, target)

    def _tool(self, name: str) -> str:
        tool = self._tools / name
        return str(tool) if tool.exists() else name

    @staticmethod
    def _libraries() -> list[str]:
        return [name + sysconfig.get_config_var("EXT_SUFFIX") for name in BUILD_TARGETS]

    def _install(self) -> None:
        for name in self._libraries():
            shutil.copyfile(self.folder / "build" / name, self.folder / "src/dualbrain/safety/cbf/compiled" / name)

    def _objects(self) -> str:
        """Return a hash of the object files of the kernel."""
        digest = hashlib.sha256()
        for path in sorted((self.folder / "build").rglob("*.c.o")):
            digest.update(path.read_bytes())
        return digest.hexdigest()

    # --- one mutant -------------------------------------------------------------------------------------------

    def apply(self, mutant: Mutant) -> str:
        """Write and compile a mutant; returns "" if it can be tested, else "does not compile" or "same object code"."""
        path = self.folder / mutant.file
        self._sources.setdefault(mutant.file, path.read_text())
        path.write_text(mutant.text)
        python = path.suffix == ".py"
        if python and not self._compiles(mutant.text):
            return "does not compile"
        if python and evaluated_code(mutant.text) == evaluated_code(self._sources[mutant.file]):
            return "same object code"
        if self._call([self._tool("ninja"), "-C", str(self.folder / "build"), *self._libraries()]).returncode:
            return "does not compile"
        if not python and self._objects() == self._original:
            return "same object code"
        self._install()
        return ""

    def revert(self, mutant: Mutant) -> None:
        """Write the original text; the next `apply` compiles it."""
        (self.folder / mutant.file).write_text(self._sources[mutant.file])

    @staticmethod
    def _compiles(text: str) -> bool:
        try:
            compile(text, "mutant", "exec")
        except SyntaxError:
            return False
        return True

    # --- tests ------------------------------------------------------------------------------------------------

    def run_tests(self, order: Path | None = None, *, first_failure: bool = True) -> tuple[Verdict, list[dict]]:
        """Run the tests, those of a step first; returns the verdict and the row of each test."""
        verdict, rows = self._run(list(STEP_TESTS), STEP_TESTS_CPU_S, None, first_failure=first_failure)
        if verdict.caught:
            return verdict, rows
        others = [*TESTS, *(f"--ignore={path}" for path in (*EXCLUDED_TESTS, *STEP_TESTS))]
        verdict, other_rows = self._run(others, self.limit, order, first_failure=first_failure)
        return verdict, rows + other_rows

    def _run(
        self, tests: list[str], limit: float, order: Path | None, *, first_failure: bool
    ) -> tuple[Verdict, list[dict]]:
        verdicts = self.folder / "build" / "verdicts.jsonl"
        verdicts.unlink(missing_ok=True)
        command = [
            "prlimit",
            f"--cpu={round(limit)}",
            sys.executable,
            "-S",
            "-m",
            "pytest",
            "-q",
            "-p",
            "tools.mutation.pytest_plugin",
            "-p",
            "no:cacheprovider",
            "--rootdir",
            str(self.folder),
            "-c",
            str(self.folder / "pyproject.toml"),
            "--verdicts",
            str(verdicts),
            *tests,
        ]
        command += ["--order", str(order)] if order else []
        command += ["-x"] if first_failure else []
        code = self._call(command, limit=100.0 * limit).returncode
        rows = [json.loads(line) for line in verdicts.read_text().splitlines()] if verdicts.exists() else []
        return classify_run(code, rows), rows

    def _call(self, command: list[str], *, check: bool = False, limit: float = 600.0) -> subprocess.CompletedProcess:
        paths = [self.folder / "src", self.folder, *(p for p in sys.path if p.endswith("-packages"))]
        tools = f"{self._tools}{os.pathsep}{os.environ.get('PATH', '')}"
        variables = {
            "PYTHONPATH": os.pathsep.join(map(str, paths)),
            "PATH": tools,
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        return subprocess.run(
            command, cwd=self.folder, env={**os.environ, **variables}, capture_output=True, timeout=limit, check=check
        )


def evaluated_code(text: str) -> str:
    """Return a dump of a Python source without annotations of parameters and return values, which are not evaluated."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
    return ast.dump(tree)


def classify_run(code: int, rows: list[dict]) -> Verdict:
    """Return the verdict for an exit code of pytest (negative: a signal) and the rows of the tests."""
    last, seconds = (rows[-1]["test"], rows[-1]["cpu"]) if rows else ("collection", 0.0)
    failed = next((row["test"] for row in rows if row.get("outcome") == "failed"), "")
    if failed:
        return Verdict(True, "test", failed, seconds)
    if code == 0:
        return Verdict(False, "", "", seconds)
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return Verdict(True, "timeout", last, seconds)
    return Verdict(True, "crash" if code < 0 else "error", last, seconds)
