"""The benchmark of the gate runs as it is documented, and the gate is far faster than a schema validator in Python."""

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "gate.py"


def test_the_benchmark_prints_one_object_and_its_ratio_is_in_reach_of_the_target() -> None:
    command = [sys.executable, str(BENCHMARK), "--json", "--rounds", "9"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    result = json.loads(answer.stdout)
    assert (result["skills"], result["steps"]) == (20, 8)
    assert result["ratio"] > 20  # the target is 30, on a machine that does nothing else
