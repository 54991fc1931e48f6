"""Compilation of the kernel for the host and for microcontrollers, and properties of its objects."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tools.kernel_limits.elf import ObjectFile, read_object, strip_clone_suffix
from tools.kernel_limits.stack_usage import CallPath, cycles, deepest_call_path

ROOT = Path(__file__).resolve().parents[2]
ENTRY_POINTS = ("dbk_step", "dbk_project")
ALLOWED_SYMBOLS = re.compile(r"(__aeabi_)?mem(cpy|set|move|clr)[48]?$|__stack_chk_fail$")
BARE_METAL_FLAGS = (
    "-target",
    "thumb-freestanding-eabihf",
    "-ffreestanding",
    "-fno-sanitize=all",
    "-fno-unwind-tables",
    "-fno-asynchronous-unwind-tables",
    "-fstack-size-section",
    "-DDBK_MAX_OBSTACLES=48",
)
ZIG = (sys.executable, "-m", "ziglang", "cc")


@dataclass(frozen=True, slots=True)
class Target:
    """Compiler and flags for one target, and the command that prints the version of the compiler."""

    name: str
    command: tuple[str, ...]
    version: tuple[str, ...]


def targets() -> list[Target]:
    """Return the targets: the host in float32 and float64, and two microcontrollers with at most 48 obstacles.

    The stack report of gcc omits the red zone (128 bytes below the stack pointer of x86-64 leaf functions), so it is
    disabled here.
    """
    flags = tuple(shipped_flags())
    small = tuple(flag for flag in flags if not flag.startswith("-O"))
    host = ("gcc", *flags, "-fstack-usage", *(["-mno-red-zone"] if platform.machine() == "x86_64" else []))
    return [
        Target("host, float32", host, ("gcc", "--version")),
        Target("host, float64", (*host, "-DDBK_DOUBLE"), ("gcc", "--version")),
        Target(
            "Cortex-M7, -O2",
            (*ZIG, *BARE_METAL_FLAGS, *small, "-mcpu=cortex_m7+fp_armv8d16sp", "-O2"),
            (*ZIG, "--version"),
        ),
        Target(
            "Cortex-M7, -Os",
            (*ZIG, *BARE_METAL_FLAGS, *small, "-mcpu=cortex_m7+fp_armv8d16sp", "-Os"),
            (*ZIG, "--version"),
        ),
        Target(
            "Cortex-M4, -Os", (*ZIG, *BARE_METAL_FLAGS, *small, "-mcpu=cortex_m4+vfp4d16sp", "-Os"), (*ZIG, "--version")
        ),
    ]


def shipped_flags() -> list[str]:
    """Return DBK_FLAGS of CMakeLists.txt."""
    found = re.search(r"set\(DBK_FLAGS ([^)]*)\)", (ROOT / "CMakeLists.txt").read_text())
    return found.group(1).split() if found else []


def run_compiler(command: tuple[str, ...]) -> str:
    """Run a compiler and return its output; the cache of zig is in build/zig."""
    cache = {name: str(ROOT / "build" / "zig") for name in ("ZIG_LOCAL_CACHE_DIR", "ZIG_GLOBAL_CACHE_DIR")}
    return subprocess.run(command, env=os.environ | cache, capture_output=True, text=True, check=True).stdout


def measure(target: Target, folder: Path) -> dict[str, object]:
    """Compile the kernel for one target into `folder`; returns its code size, stack and symbols."""
    folder.mkdir(parents=True, exist_ok=True)
    objects: list[ObjectFile] = []
    stack: dict[str, int] = {}
    for source in sorted((ROOT / "kernel/src").rglob("*.c")):
        out = folder / f"{source.stem}.o"
        run_compiler(
            (
                *target.command,
                "-std=c99",
                "-ffunction-sections",
                f"-I{ROOT / 'kernel/include'}",
                f"-I{ROOT / 'kernel/src'}",
                "-c",
                str(source),
                "-o",
                str(out),
            )
        )
        objects.append(read_object(out))
        stack |= {f"{strip_clone_suffix(name)}": size for name, size in objects[-1].stack.items()}
        report = out.with_suffix(".su")
        stack |= _parse_stack_report(report.read_text()) if report.exists() else {}
    return {
        "target": target.name,
        "compiler": run_compiler(target.version).splitlines()[0],
        **summary(objects, stack),
        "sizes": structure_sizes(target, folder),
    }


def summary(objects: list[ObjectFile], stack: dict[str, int]) -> dict[str, object]:
    """Return the deepest call paths, recursion, and all symbols that no object of the kernel defines."""
    calls: dict[str, set[str]] = {}
    for one in objects:
        for caller, callees in one.calls.items():
            calls.setdefault(caller, set()).update(callees)
    own = {strip_clone_suffix(name) for one in objects for name in one.code}
    foreign = sorted(
        {name for one in objects for name in one.undefined if name not in own and not name.startswith(".")}
    )
    recursion = cycles(calls)
    paths = {entry: CallPath((), -1) if recursion else deepest_call_path(entry, calls, stack) for entry in ENTRY_POINTS}
    return {
        "code": sum(size for one in objects for size in one.code.values()),
        "frames": dict(sorted(stack.items(), key=lambda item: -item[1])),
        "unsized": sorted(own - set(stack)),
        "paths": {entry: {"functions": path.functions, "stack": path.stack} for entry, path in paths.items()},
        "recursion": recursion,
        "addresses_taken": sorted({name for one in objects for name in one.addresses_taken}),
        "foreign": foreign,
        "not_allowed": [name for name in foreign if not ALLOWED_SYMBOLS.match(name)],
    }


def _parse_stack_report(text: str) -> dict[str, int]:
    """Parse the report of gcc -fstack-usage: `file:line:column:function<tab>bytes<tab>kind` per line."""
    rows = (line.split("\t") for line in text.splitlines())
    return {name.rsplit(":", 1)[-1]: int(size) for name, size, _ in rows}


def structure_sizes(target: Target, folder: Path) -> dict[str, int]:
    """Return the sizes of the structures that the caller provides [bytes], read from the symbols of an object."""
    source = folder / "sizes.c"
    names = ("dbk_model", "dbk_scene", "dbk_ctx", "dbk_in", "dbk_out")
    source.write_text('#include "dbk/dbk.h"\n' + "".join(f"char size_of_{n}[sizeof({n})] = {{1}};\n" for n in names))
    out = folder / "sizes.o"
    run_compiler((*target.command, f"-I{ROOT / 'kernel/include'}", "-c", str(source), "-o", str(out)))
    listing = run_compiler(("nm", "-S", str(out))).split("\n")
    rows = (line.split() for line in listing if "size_of_" in line)
    return {row[-1].removeprefix("size_of_"): int(row[1], 16) for row in rows}
