"""Instructions of one step on a Cortex-M4F, counted by an emulator (Unicorn).

    python -m tools.instruction_counts [--robot panda] [--toolchain zig] [--level -O2] [--profile]
    python -m tools.instruction_counts --record [--write-docs]

Counts are exact and repeatable, and are no cycles: the emulator has no caches and no flash wait states. `--record`
writes counts.json for all builds whose compiler is installed (gcc needs the Debian package gcc-arm-none-eabi), and
keeps the other entries.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

from tools.instruction_counts.measure import COUNTS_FILE, SHIPPED, TOOLCHAINS, Build, committed_counts, measure
from tools.instruction_counts.report import PAGE, render_page
from tools.kernel_limits.compiled import ROOT


def main() -> int:
    """Measure one build, or record all of them."""
    options = _parse(sys.argv[1:])
    if options.record:
        _record()
    if options.write_docs:
        (ROOT / PAGE).write_text(render_page(committed_counts()))
    if not (options.record or options.write_docs):
        _print(Build(options.toolchain, options.level, options.robot), profile=options.profile)
    return 0


def _record() -> None:
    found = committed_counts() if COUNTS_FILE.exists() else {}
    for program in SHIPPED:
        if shutil.which(TOOLCHAINS[program.toolchain].command[0]) is None:
            print(f"{program.name}: the compiler is not installed", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory() as folder:
            loops = measure(program, Path(folder))
        found[program.name] = {str(loop.obstacles): loop.as_record() for loop in loops}
        print(program.name, file=sys.stderr, flush=True)
    COUNTS_FILE.write_text(json.dumps(found, indent=1) + "\n")


def _print(program: Build, *, profile: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        loops = measure(program, Path(folder))
    print("obstacles       mean    maximum      first  hash")
    for loop in loops:
        print(f"{loop.obstacles:9} {loop.mean:10.0f} {loop.most:10} {loop.first:10}  {loop.hash}")
        for name, count in sorted(loop.profile.items(), key=lambda item: -item[1])[:12] if profile else ():
            print(f"{'':10}{name:32} {count:10.0f}")


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.instruction_counts")
    parser.add_argument("--toolchain", choices=sorted(TOOLCHAINS), default="zig")
    parser.add_argument("--level", default="-O2")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--write-docs", action="store_true")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
