"""The benchmark of the gate runs as documented, and the gate is much faster than a schema validator in Python."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_benchmark_prints_one_object_with_a_ratio_near_the_target() -> None:
    command = [
        sys.executable,
        *(["-S"] if sys.flags.no_site else []),
        "-m",
        "benchmarks.gate",
        "--json",
        "--rounds",
        "9",
    ]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    result = json.loads(answer.stdout)
    assert (result["skills"], result["steps"]) == (20, 8)
    assert result["ratio"] > 20  # the target of 30 holds on an otherwise idle machine
