"""Runs a given contract through gate, skills, filter and physics, without planner and memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.control_loop import ControlLoopConfig, LoopObserver, TickSnapshot
from dualbrain.control.recording.trace import Trace
from dualbrain.records import Judgement, Outcome
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.simulation.world import make_world
from experiments.engine.experiment import Row

PICK_AND_PLACE_GOAL = PlacementGoal("red_cube", "blue_bowl")
FORBIDDEN_VIOLATIONS = (
    "collision_env",
    "collision_human",
    "self_collision",
    "collision_held",
    "joint_limit",
    "joint_velocity",
)
"""Kinds of violation that must not occur at all; other kinds are only listed."""
GRASP_PARAMETERS = {
    "object": "red_cube",
    "speed": 0.2,
    "clearance": 0.15,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 20.0,
}
PLACE_PARAMETERS = {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ContractRun:
    """The result of a contract: outcome or rejection, judgement on ground truth, trace, and the plant at the end."""

    outcome: Outcome | None
    rejection: Rejected | None
    judgement: Judgement
    trace: Trace
    plant: Plant


@cache
def load_panda() -> RobotModel:
    """The Panda's model, loaded once per process."""
    return load_robot("panda")


def pick_and_place_actions(**values: Any) -> list[dict[str, Any]]:
    """The actions that grasp the red cube and place it in the bowl; `values` replace parameters of both actions."""
    grasp, place = (
        {name: values.get(name, value) for name, value in base.items()} for base in (GRASP_PARAMETERS, PLACE_PARAMETERS)
    )
    return [{"skill": "grasp", "params": grasp}, {"skill": "place", "params": place}]


def run_contract(
    spec: SceneSpec,
    actions: list[dict[str, Any]],
    *,
    seed: int = 0,
    settle_s: float = 0.2,
    goal: PlacementGoal | ArrivalGoal | None = PICK_AND_PLACE_GOAL,
    guard: bool = True,
    on_tick: Callable[[TickSnapshot], None] | None = None,
) -> ContractRun:
    """Hold position for `settle_s` [s], check the contract by the gate with the scene's rules, and execute it.

    The filter is on unless `guard` is False; `on_tick` receives snapshots of control ticks.
    """
    model = load_robot(spec.robot)
    cell = SimulatedCell(
        model,
        make_world(spec, model, seed=seed, goal=goal),
        config=ControlLoopConfig(guard=guard),
        observer=LoopObserver(on_tick=on_tick),
    )
    cell.executor.hold(settle_s)
    verdict = cell.check(cell.contract(actions))
    if isinstance(verdict, Rejected):
        return ContractRun(
            outcome=None, rejection=verdict, judgement=cell.judgement(), trace=cell.log.trace, plant=cell.plant
        )
    outcome = cell.executor.execute(verdict.contract)
    return ContractRun(
        outcome=outcome, rejection=None, judgement=cell.judgement(), trace=cell.log.trace, plant=cell.plant
    )


def run_row(run: ContractRun) -> Row:
    """The row of a run."""
    if run.outcome is None:
        why = run.rejection
        return {"valid": False, "reason": f"{why.stage} {why.pointer}: {why.hint}" if why else ""}
    delta = run.trace["delta"]
    return {
        "valid": True,
        **outcome_fields(run.outcome),
        **judgement_fields(run.judgement),
        "delta_max": float(delta.max()),
        "ticks": len(delta),
    }


def outcome_fields(outcome: Outcome) -> Row:
    """The outcome according to the robot, and its Δ."""
    return {
        "outcome": outcome.kind,
        "reason": outcome.reason,
        "Delta": outcome.Delta,
        "Delta_sum": outcome.Delta_sum,
        "delta_peak": outcome.delta_peak,
        "frequency": outcome.intervention_frequency,
        "h_min": outcome.h_min,
        "duration": outcome.duration,
    }


def judgement_fields(judgement: Judgement | None) -> Row:
    """Success and violations on ground truth."""
    if judgement is None:
        return {"truth": False, "progress": 0.0, "violations": []}
    violations = msgspec.to_builtins(judgement.violations)
    return {"truth": judgement.success, "progress": judgement.progress, "violations": violations}


def succeeded(row: Row) -> bool:
    """Whether the robot reports success and ground truth agrees."""
    return row.get("outcome") == "succeeded" and row["truth"]


def count_violations(rows: list[Row]) -> Counter[str]:
    """Number of violations of each kind; those with an object that was not perceived are counted apart."""
    return Counter(
        violation["kind"] + ("" if violation["perceived"] else " (not perceived)")
        for row in rows
        for violation in row.get("violations", ())
    )


def describe_violations(row: Row) -> str:
    """All violations of a row as text."""
    return "; ".join(
        f"{v['kind']} {' × '.join(v['bodies'])} at {v['start']:.2f} s for {v['duration']:.2f} s, peak {v['peak']:.3g}"
        + ("" if v["perceived"] else " (not perceived)")
        for v in row.get("violations", ())
    )


def describe_outcome(row: Row) -> str:
    """The outcome of a row, for the progress line."""
    if not row.get("valid", True):
        return f"rejected: {row['reason']}"
    Delta = row.get("Delta")
    measure = f"Δ {Delta:.4f}, {row['duration']:.1f} s" if Delta is not None else ""
    word = "success" if succeeded(row) else f"{row['outcome']} ({row['reason']}), truth {row['truth']}"
    return ", ".join(part for part in (word, measure, describe_violations(row)) if part)
