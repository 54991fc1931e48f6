"""The golden hashes in golden.json: one per case and number type.

Run `python -m tests.kernel.golden_hashes` only after an intended change of the kernel's arithmetic or for a new case.
"""

import json
import tempfile
from pathlib import Path

from tests.kernel.compilers import GCC, build_program

FILE = Path(__file__).with_name("golden.json")


def hashes(program):
    """Hash by case, as printed by the golden program."""
    return {line.split()[0]: line.split()[1] for line in program.output_lines()}


def recorded_hashes():
    """Recorded hash by number type and case."""
    return json.loads(FILE.read_text())


def record_hashes():
    """Record the hashes of a build with gcc -O2."""
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
