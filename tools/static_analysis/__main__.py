"""Static analysis and fuzzing of the C kernel: `make analysis`.

    python -m tools.static_analysis [--only output] [--again] [--write-docs]

Results are kept in tools/static_analysis/results.json with the hash of the kernel, and an analysis that has a result of
the same kernel is not repeated. The programs are no part of the set-up (Debian): frama-c-base, cppcheck, clang,
libclang-rt-14-dev.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from dualbrain.safety.cbf.kernel import kernel_hash
from tools.kernel_limits.compiled import ROOT
from tools.static_analysis.checks import CHECKS, missing_programs
from tools.static_analysis.report import PAGE, render_page

RESULTS = Path(__file__).with_name("results.json")


def main() -> int:
    """Run the analyses that have no result of this kernel."""
    options = _parse(sys.argv[1:])
    if missing_programs():
        print(f"Not installed: {', '.join(missing_programs())}. See the module's docstring.", file=sys.stderr)
    results: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name, (program, check) in CHECKS.items():
        fresh = results.get(name, {}).get("kernel") == kernel_hash()
        if options.only not in (None, name) or program in missing_programs() or (fresh and not options.again):
            continue
        print(name, file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            results[name] = {"kernel": kernel_hash(), **check(Path(folder))}
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))
    if options.write_docs:
        (ROOT / PAGE).write_text(render_page(results))
    return 0


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.static_analysis")
    parser.add_argument("--only", choices=sorted(CHECKS))
    parser.add_argument("--again", action="store_true", help="repeat analyses that have a result")
    parser.add_argument("--write-docs", action="store_true")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
