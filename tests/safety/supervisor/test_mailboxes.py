"""The mailboxes of the control loop between two threads: no value is torn or lost uncounted, and no data race."""

import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
REALTIME = HERE.parents[2] / "kernel/realtime"
FLAGS = [
    "-std=c99",
    "-O1",
    "-g",
    "-Wall",
    "-Wextra",
    "-Werror",
    f"-I{REALTIME}",
    str(HERE / "mailboxes.c"),
    "-lpthread",
]


@pytest.mark.parametrize("sanitizer", ["none", "thread"])
def test_values_arrive_whole_in_order_and_are_counted(tmp_path, sanitizer):
    program = tmp_path / "mailboxes"
    extra = ["-fsanitize=thread"] if sanitizer == "thread" else []
    built = subprocess.run(["gcc", *extra, *FLAGS, "-o", str(program)], capture_output=True, text=True, check=False)
    if sanitizer == "thread" and "tsan" in built.stderr:
        pytest.skip("ThreadSanitizer is not installed")
    assert built.returncode == 0, built.stderr
    fixed_addresses = ["setarch", "-R"] if shutil.which("setarch") else []  # its shadow memory needs them
    done = subprocess.run([*fixed_addresses, str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
