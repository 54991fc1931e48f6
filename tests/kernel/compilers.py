"""The kernel and a C program, compiled by any compiler with the flags of CMakeLists.txt."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WARNINGS = [
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wconversion",
    "-Wshadow",
    "-Wdouble-promotion",
    "-Wstrict-prototypes",
    "-Werror",
]
MORE_SOURCES = {"golden": ["golden_cases"]}
INCLUDES = [f"-I{ROOT / 'kernel/include'}", f"-I{ROOT / 'kernel/src'}", f"-I{ROOT / 'tests/kernel'}"]


@cache
def compiler_flags():
    """DBK_FLAGS of CMakeLists.txt without the optimisation level."""
    text = (ROOT / "CMakeLists.txt").read_text()
    words = re.search(r"set\(DBK_FLAGS ([^)]*)\)", text)
    return [word for word in words.group(1).split() if not word.startswith("-O")]


@dataclass(frozen=True)
class Compiler:
    """How one is called, and what it needs beside the common flags."""

    name: str
    command: tuple[str, ...]
    extra: tuple[str, ...] = ()

    def run(self, *arguments, cwd=None):
        """Call it; its complaints are the test's."""
        # zig keeps what it has built beside our own build products, never in the user's home
        place = str(ROOT / "build" / "zig")
        more = {"ZIG_LOCAL_CACHE_DIR": place, "ZIG_GLOBAL_CACHE_DIR": place}
        command = [*self.command, "-std=c99", *compiler_flags(), *self.extra, *arguments]
        done = subprocess.run(command, cwd=cwd, env=os.environ | more, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr}"
        return done.stdout


ZIG = (sys.executable, "-m", "ziglang", "cc")
GCC = Compiler("gcc", ("gcc",), ("-Wno-maybe-uninitialized",))
CLANG = Compiler("clang", ZIG, ("-mcpu=baseline", "-fno-sanitize=all"))
"""zig adds to clang: its own -march (the host's), and traps for undefined behaviour below -O2; both are taken away."""
CLANG_HOST = Compiler("clang", ZIG, ("-mcpu=native", "-fno-sanitize=all"))
CLANG_TRAPS = Compiler("clang", ZIG, ("-mcpu=native", "-fsanitize=undefined", "-fsanitize-trap=undefined"))


@dataclass(frozen=True)
class Program:
    """A compiled C program."""

    path: Path

    def output_lines(self, *arguments):
        """What it prints; it must end well."""
        done = subprocess.run([str(self.path), *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"exit {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout.splitlines()


def kernel_sources():
    """The kernel's files."""
    return sorted(str(path) for path in (ROOT / "kernel/src").rglob("*.c"))


def build_program(folder, name, compiler, *more):
    """tests/kernel/<name>.c with the kernel."""
    out = folder / name
    own = [str(ROOT / "tests/kernel" / f"{file}.c") for file in (name, *MORE_SOURCES.get(name, ()))]
    compiler.run(*WARNINGS, *more, *INCLUDES, *kernel_sources(), *own, "-o", str(out))
    return Program(out)
