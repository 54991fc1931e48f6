"""A stranger's path: from a URDF in a folder to a filtered robot that can be looked at, in four commands.

    python examples/12_your_robot.py [FILE.urdf]

By default the robot is a UR5 out of `example-robot-data`. Needs `pip install 'dualbrain[all]'`.
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

from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter

ROBOT = "ur_description/urdf/ur5_robot.urdf"
STATED = ("--acceleration", "8", "--period", "0.002", "--tool-speed", "0.25")
"""What no URDF says; left out, `init` asks for it."""


def urdf():
    """The file that was asked for, or the UR5's."""
    if len(sys.argv) > 1:
        return Path(sys.argv[1])
    found = next(file for file in metadata.files("example-robot-data") or [] if str(file).endswith(ROBOT))
    return Path(str(found.locate()))


def dualbrain(*words):
    """One command, as it would be typed; its exit code and what it says."""
    program = "import sys; from dualbrain.cli.main import main; main()"
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=False)
    print(f"$ dualbrain {' '.join(words)}\n  exit code {done.returncode}")
    return done.returncode, done.stdout + done.stderr


began, folder = time.monotonic(), Path(tempfile.mkdtemp()) / "my_robot"

code, said = dualbrain("robot", "init", str(urdf()), "--out", str(folder), "--quick")
assert code == 5, said
print("  asked for: " + ", ".join(word for word in ("--acceleration", "--period", "--tool-speed") if word in said))
code, said = dualbrain("robot", "init", str(urdf()), "--out", str(folder), "--quick", *STATED)
assert code == 0, said
print("  " + "\n  ".join(line.strip() for line in said.splitlines() if "cover:" in line or "missing: tracking" in line))
code, said = dualbrain("schema", "--robot", str(folder), "--form", "short")
assert code == 0, said
print(f"  skills: {', '.join(line.split('(')[0] for line in said.splitlines() if '(' in line)}")
code, said = dualbrain("robot", "inspect", str(folder), "--view", "--port", "18210")
print("  " + next(line for line in said.splitlines() if "Look at" in line))

robot_model = load_robot(str(folder))
safety = SafetyFilter(robot_model, FilterConfig(tracking_error=0.0, lag_compensation=False))
q, u, least = np.array(robot_model.home), np.zeros(robot_model.n), np.inf
table = float(min(safety.spheres(q, 0.0)[0][:, 2])) - 0.4
safety.observe([Obstacle("table", HalfSpace(), Pose((0.0, 0.0, table)))])
for _ in range(4000):
    J = safety.tool(q).jacobian[:3]
    answer = safety(q, u, J.T @ np.linalg.solve(J @ J.T + 1e-3 * np.eye(3), np.array([0.0, 0.0, -0.5])))
    q, u, least = q + robot_model.period * answer.u, answer.u, min(least, answer.h_min)
print(f"pushed at the table for {4000 * robot_model.period:.0f} s: {answer.explain()}; least h {least * 1e3:.2f} mm")
busy = sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))
print(
    f"four commands, {time.monotonic() - began:.0f} s, {busy:.0f} s of one processor; folder {folder.name}: "
    f"{', '.join(sorted(path.name for path in folder.iterdir()))}"
)
