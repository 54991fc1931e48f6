"""The golden hashes: one a case and number type, in golden.json.

Run: python -m tests.kernel.golden_hashes (only when the kernel's arithmetic is changed on purpose, or a case is added).
"""

import json
import tempfile
from pathlib import Path

from tests.kernel.compilers import GCC, build_program

FILE = Path(__file__).with_name("golden.json")


def hashes(program):
    """Case -> hash, as printed by the golden program."""
    return {line.split()[0]: line.split()[1] for line in program.output_lines()}


def recorded_hashes():
    """Number type -> case -> hash."""
    return json.loads(FILE.read_text())


def record_hashes():
    """Write what gcc -O2 gives."""
    with tempfile.TemporaryDirectory() as folder:
        FILE.write_text(
            json.dumps(
                {
                    "float32": hashes(build_program(Path(folder), "golden", GCC, "-O2")),
                    "float64": hashes(build_program(Path(folder), "golden", GCC, "-O2", "-DDBK_DOUBLE")),
                },
                indent=1,
            )
            + "\n"
        )


if __name__ == "__main__":
    record_hashes()
