"""A process that starts a Ray cluster of two nodes with a token, works on it, and writes the results.

The token is in variables of its environment, because Ray reads them when it is imported.
"""

import json
import os
import sys
from pathlib import Path

from ray.cluster_utils import Cluster

from dualbrain.cli.main import run_command_line
from dualbrain.evaluation.runner.ray_cluster.connection import check_nodes, connected
from dualbrain.evaluation.runner.ray_cluster.pool import RayPool
from tests.evaluation.runner.test_worker_pool import SampleUnit, make_doubler

RESULTS = "results.json"
TIME_FIELDS = ("wall", "wall_s", "gate_s", "filter_us", "planner_s", "ledger")
"""Fields of a row that contain measured times; the hash of a ledger covers the times in its episodes."""


def summary(reports):
    """By key: number of lines, and the error."""
    found = {}
    for report in reports:
        one = found.setdefault(report.unit.key, {"lines": 0, "error": ""})
        one["lines"] += report.line is not None
        one["error"] = report.error or one["error"]
    return found


def rows(folder, *options):
    """The rows of one method of the smoke suite, by key."""
    command = ["evaluate", "--suite", "smoke", "--methods", "B1,B4", "--out", str(folder), *options]
    assert run_command_line(command) == 0
    lines = map(json.loads, (folder / "fly.jsonl").read_text().splitlines())
    return {line["key"]: line for line in lines}


def main(folder):
    results = {"serial rows": rows(folder / "serial", "--jobs", "1")}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    node = cluster.add_node(num_cpus=1)
    os.environ["RAY_ADDRESS"] = cluster.address
    results["cluster rows"] = rows(folder / "cluster", "--pool", "ray")
    with connected(os.environ, folder):
        check_nodes(folder / "cluster" / "config.json")
        pool = RayPool(make_doubler, 2, environment={"MUJOCO_GL": "disable"})
        units = [SampleUnit("zero", {"n": 0}), SampleUnit("dead", {"n": 1, "die": True})]
        units += [SampleUnit(str(n), {"n": n}) for n in range(1, 6)]
        results |= {"units": summary(pool.run_units(units)), "lost": pool.lost_workers}
        reports, removed = [], False
        for report in pool.run_units([SampleUnit(str(n), {"n": n, "pause_s": 1.0}) for n in range(1, 7)]):
            reports.append(report)
            if not removed:
                cluster.remove_node(node, allow_graceful=False)
                removed = True
        results["lost node"] = summary(reports)
    cluster.shutdown()
    (folder / RESULTS).write_text(json.dumps(results))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
