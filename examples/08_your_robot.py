"""From a URDF file to a robot behind the filter, in four commands.

    python examples/08_your_robot.py [FILE.urdf]

The default is the UR5 of `example-robot-data`. Needs `pip install 'dualbrain[all]'`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

import numpy as np

from dualbrain import FilterConfig, HalfSpace, Obstacle, Pose, SafetyFilter, load_robot

ROBOT = "ur_description/urdf/ur5_robot.urdf"
STATED = ("--acceleration", "8", "--period", "0.002", "--tool-speed", "0.25")
"""Limits that a URDF does not state; `init` lists them if they are missing."""


def urdf():
    """The given file, or that of the UR5."""
    if len(sys.argv) > 1:
        return Path(sys.argv[1])
    found = next(file for file in metadata.files("example-robot-data") or [] if str(file).endswith(ROBOT))
    return Path(str(found.locate()))


def dualbrain(*arguments):
    """Run one command; returns its exit code and output."""
    command = [sys.executable, "-m", "dualbrain", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    print(f"$ dualbrain {' '.join(arguments)}\n  exit code {done.returncode}")
    return done.returncode, done.stdout + done.stderr


started, folder = time.monotonic(), Path(tempfile.mkdtemp()) / "my_robot"

code, output = dualbrain("robot", "init", str(urdf()), "--out", str(folder), "--quick")
assert code == 5, output
print("  missing: " + ", ".join(word for word in ("--acceleration", "--period", "--tool-speed") if word in output))
code, output = dualbrain("robot", "init", str(urdf()), "--out", str(folder), "--quick", *STATED)
assert code == 0, output
print(
    "  "
    + "\n  ".join(line.strip() for line in output.splitlines() if "coverage:" in line or "missing: tracking" in line)
)
code, output = dualbrain("schema", "--robot", str(folder), "--form", "short")
assert code == 0, output
print(f"  skills: {', '.join(line.split('(')[0] for line in output.splitlines() if '(' in line)}")
code, output = dualbrain("robot", "inspect", str(folder), "--view", "--port", "18210")
print("  " + next(line for line in output.splitlines() if "view:" in line))

robot_model = load_robot(str(folder))
safety = SafetyFilter(robot_model, FilterConfig(tracking_error=0.0, lag_compensation=False))
q, u, least = np.array(robot_model.home), np.zeros(robot_model.n), np.inf
table = float(min(safety.spheres(q, 0.0)[0][:, 2])) - 0.4
safety.observe([Obstacle("table", HalfSpace(), Pose((0.0, 0.0, table)))])
for _ in range(4000):
    J = safety.tool(q).jacobian[:3]
    result = safety(q, u, J.T @ np.linalg.solve(J @ J.T + 1e-3 * np.eye(3), np.array([0.0, 0.0, -0.5])))
    q, u, least = q + robot_model.period * result.u, result.u, min(least, result.h_min)
print(f"push at the table for {4000 * robot_model.period:.0f} s: {result.explain()}; minimum h {least * 1e3:.2f} mm")
cpu_time = sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))
print(
    f"four commands, {time.monotonic() - started:.0f} s, {cpu_time:.0f} s of processor time; folder {folder.name}: "
    f"{', '.join(sorted(path.name for path in folder.iterdir()))}"
)
