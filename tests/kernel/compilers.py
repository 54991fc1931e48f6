"""Builds the kernel with a C program, by any compiler and with the flags of CMakeLists.txt."""

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
    match = re.search(r"set\(DBK_FLAGS ([^)]*)\)", text)
    return [flag for flag in match.group(1).split() if not flag.startswith("-O")]


@dataclass(frozen=True)
class Compiler:
    """The command of a compiler, and its flags in addition to the common ones."""

    name: str
    command: tuple[str, ...]
    extra: tuple[str, ...] = ()

    def run(self, *arguments, cwd=None):
        """Run the compiler; a compiler error fails the test."""
        # zig stores its cache in the build folder, not in the user's home
        cache_folder = str(ROOT / "build" / "zig")
        zig = {"ZIG_LOCAL_CACHE_DIR": cache_folder, "ZIG_GLOBAL_CACHE_DIR": cache_folder}
        command = [*self.command, "-std=c99", *compiler_flags(), *self.extra, *arguments]
        done = subprocess.run(command, cwd=cwd, env=os.environ | zig, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{' '.join(command)}\n{done.stderr}"
        return done.stdout


ZIG = (sys.executable, "-m", "ziglang", "cc")
GCC = Compiler("gcc", ("gcc",), ("-Wno-maybe-uninitialized",))
CLANG = Compiler("clang", ZIG, ("-mcpu=baseline", "-fno-sanitize=all"))
"""zig adds -march of the host and, below -O2, traps for undefined behaviour; these flags remove both."""
CLANG_HOST = Compiler("clang", ZIG, ("-mcpu=native", "-fno-sanitize=all"))
CLANG_TRAPS = Compiler("clang", ZIG, ("-mcpu=native", "-fsanitize=undefined", "-fsanitize-trap=undefined"))


@dataclass(frozen=True)
class Program:
    """A compiled C program."""

    path: Path

    def output_lines(self, *arguments):
        """The lines that the program prints; a non-zero exit code fails the test."""
        done = subprocess.run([str(self.path), *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"exit {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout.splitlines()


def kernel_sources():
    """The source files of the kernel."""
    return sorted(str(path) for path in (ROOT / "kernel/src").rglob("*.c"))


def build_program(folder, name, compiler, *more):
    """Build tests/kernel/<name>.c with the kernel."""
    out = folder / name
    sources = [str(ROOT / "tests/kernel" / f"{file}.c") for file in (name, *MORE_SOURCES.get(name, ()))]
    compiler.run(*WARNINGS, *more, *INCLUDES, *kernel_sources(), *sources, "-o", str(out))
    return Program(out)
