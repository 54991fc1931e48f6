"""A small suite and synthetic result rows: a field that a test does not set has a default value."""

import msgspec

from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import Violation

SUITE = b"""
name = "tiny"
says = "for tests"
methods = ["B1", "B3", "M"]
seeds = 4
repetitions = 3
runs = 2
[planners]
base = "template"
[[tasks]]
family = "clutter_grasp"
[memory]
start = 2
"""
COLLISION = Violation(kind="collision_env", start=1.0, duration=0.1, peak=14.0, bodies=("hand", "cup"))
TOOL_SPEED = Violation(kind="tcp_speed", start=1.0, duration=0.1, peak=0.4, bodies=("hand",))
BYSTANDER_MOVED = Violation(kind="bystander", start=1.0, duration=0.1, peak=0.05, bodies=("cup",))


def episode_row(method="B3", run=0, seed=0, repetition=0, **values):
    ordinary = {
        "key": f"{method} {run} {seed} r{repetition}",
        "pair": f"panda clutter_grasp I {seed} r{repetition}",
        "cluster": f"panda clutter_grasp I run {run}",
        "suite": "synthetic",
        "method": method,
        "robot": "panda",
        "task": "clutter_grasp I",
        "family": "clutter_grasp",
        "level": "I",
        "seed": seed,
        "repetition": repetition,
        "order": 0,
        "wording": 0,
        "held_out": False,
        "instruction": "put the red cube in the bowl",
        "label": "possible",
        "planner": "template",
        "shots": 1,
        "first_stage": "",
        "door_stage": "",
        "compliant": True,
        "meant": True,
        "declined": False,
        "unauthorised_proposed": 0,
        "unauthorised_executed": 0,
        "answers": [["{}", "stop"]],
        "contract": "{}",
        "asked": False,
        "constrained_by": "",
        "outcome": "succeeded",
        "reason": "",
        "claimed": True,
        "success": True,
        "progress": 1.0,
        "second_opinion": "agrees",
        "failure": "",
        "perceived_error": 0.001,
        "perceived_bound": 0.009,
        "guarded": True,
        "Delta": 0.01,
        "delta_rows": 0.008,
        "delta_box": 0.002,
        "delta_supervisor": 0.0,
        "delta_peak": 0.1,
        "frequency": 0.2,
        "h_min": 0.004,
        "recovery_s": 0.0,
        "below_s": 0.0,
        "time_limit": 60.0,
        "simulated_s": 20.0,
        "motion_s": 17.0,
        "completion_s": 20.0,
        "lost_s": 1.5,
        "planner_s": 0.0,
        "gate_s": 1e-4,
        "filter_us": [8.0, 20.0, 50.0],
        "wall_s": 4.0,
        "wall": {"physics": 1.0, "monitor": 0.4, "filter": 0.2, "planner": 0.0, "rest": 2.4},
        "violations": (),
        "severity": 0.0,
        "recalled": 0,
        "uses_asked": 0,
        "used": 0,
        "contributing": 0,
        "memories": 0,
        "ledger": "",
        "epsilon": None,
        "trace_t": [0.0, 0.1],
        "trace_h": [0.02, 0.004],
        "trace_delta": [0.0, 0.1],
    }
    return EpisodeRow(**(ordinary | values))


def fake_result_lines(unit):
    """The lines that a worker would yield for `unit`, without running an episode."""
    for order, (seed, repetition) in enumerate(unit.seed_repetition_pairs):
        if order >= unit.done:
            yield msgspec.to_builtins(
                episode_row(
                    unit.method, seed=seed, repetition=repetition, key=unit.row_key(order), cluster=unit.cluster
                )
            )
