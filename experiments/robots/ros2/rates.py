"""Rates and latencies of the ROS 2 node between real rclpy nodes, over DDS."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.robots.loader import load_robot
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.robots.ros2.virtual_environment import create, peer_command, peer_variables

RATES = (100, 200, 250, 500)
"""Rates of the joint states [Hz]."""
RUNS, SECONDS = 3, 15.0
"""Runs at each rate, and their duration [s]."""
COMMANDS, SAFE = "/policy/commands", "/velocity_controller/commands"
SITE = """
[[plane]]
name = "table"
point = [0, 0, -0.05]
inward = [0, 0, 1]
parts = ["arm", "hand", "fingers"]

[[keep_out]]
name = "crate"
position = [0.45, 0.42, 0.3]
half_extents = [0.1, 0.1, 0.3]
"""
MAX_DOMAIN = 200


class Ros2Rates:
    """Share of joint states with an answer in time, and its latency."""

    name = "ros2_rates"
    claim = (
        "Between rclpy nodes over DDS, the filter node answers a joint state within three milliseconds (median), a "
        "fraction of the period up to 250 Hz; the share of states answered within their period depends on the load."
    )
    intervals = "lowest and highest value of the runs"

    def units(self, options: Options) -> list[WorkUnit]:
        """All rates, then again."""
        del options
        return [
            WorkUnit(f"{rate} Hz {run}", {"rate": rate, "seconds": SECONDS}) for run in range(RUNS) for rate in RATES
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One run of node and peer; the environment of rclpy is created if it is missing."""
        create()
        load = os.getloadavg()[0]
        found = measure(parameters["rate"], parameters["seconds"])
        times = 1e3 * np.array([one for one in found["latencies"] if one is not None] or [np.nan])
        return {
            "rate": parameters["rate"],
            "sent": found["sent"],
            "answered": sum(one is not None for one in found["latencies"]),
            "latency_ms": [float(np.percentile(times, share)) for share in (50, 90, 99, 100)],
            "load_before": load,
        }

    def summarize_row(self, row: Row) -> str:
        """Share and median."""
        return f"{row['answered'] / max(1, row['sent']):.1%} in time, median {row['latency_ms'][0]:.2f} ms"

    def report(self, rows: list[Row]) -> list[str]:
        """One line per rate."""
        head = (
            "joint states",
            "runs",
            "states",
            "answered in the period",
            "median [ms]",
            "90 %",
            "99 %",
            "load before",
        )
        return markdown_table(head, (_line(rate, rows) for rate in RATES if any(row["rate"] == rate for row in rows)))


def _line(rate: int, rows: list[Row]) -> tuple[object, ...]:
    runs = [row for row in rows if row["rate"] == rate]
    shares = [100.0 * row["answered"] / max(1, row["sent"]) for row in runs]
    latencies = np.array([row["latency_ms"] for row in runs])
    return (
        f"{rate} Hz",
        len(runs),
        sum(row["sent"] for row in runs),
        f"{_spread(shares, 1)} %",
        *(_spread(latencies[:, column], 2) for column in range(3)),
        _spread([row["load_before"] for row in runs], 1),
    )


def _spread(values: Any, digits: int) -> str:
    """The median of `values` over the runs, with the lowest and the highest."""
    return f"{np.median(values):.{digits}f} [{np.min(values):.{digits}f}, {np.max(values):.{digits}f}]"


def measure(rate: int, seconds: float) -> dict[str, Any]:
    """Number of joint states sent at `rate` [Hz] for `seconds`, and the latency [s] of each; None without an answer."""
    robot_model = load_robot("panda")
    domain = 1 + os.getpid() % MAX_DOMAIN
    job = {
        "joints": [joint.name for joint in robot_model.joints],
        "home": list(robot_model.home),
        "urdf": "",
        "command": [0.0] * 6 + [0.1],
        "do": "rate",
        "rate": rate,
        "seconds": seconds,
    }
    with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
        node = _start_node(Path(name), rate, domain)
        try:
            done = subprocess.run(
                peer_command(json.dumps(job)), env=peer_variables(domain), stdout=subprocess.PIPE, check=True
            )
            node.send_signal(signal.SIGINT)
            node.wait(timeout=10.0)
        finally:
            node.kill()
            node.wait()
    return json.loads(done.stdout)


def _start_node(folder: Path, rate: int, domain: int) -> subprocess.Popen[bytes]:
    entries = {
        "period": 1.0 / rate,
        "state_timeout": 0.1,
        "check_description": "none",
        "command_topic": COMMANDS,
        "safe_command_topic": SAFE,
    }
    lines = "".join(f"    {name}: {value}\n" for name, value in entries.items())
    (folder / "node.yaml").write_text(f"/**:\n  ros__parameters:\n{lines}")
    (folder / "site.toml").write_text(SITE)
    command = [sys.executable, "-m", "dualbrain", "ros2", "node", "--params", str(folder / "node.yaml")]
    command += ["--site", str(folder / "site.toml"), "--domain", str(domain)]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL, env={**os.environ, "CYCLONEDDS_URI": ""})
