"""A given contract through gate, skills, filter and physics, without planner and memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
import numpy as np

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Rejected
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig, Moment
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import grants, scene_names, vocabulary
from dualbrain.records import Judgement, Outcome
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import At
from dualbrain.simulation.tasks.placement import Goal
from dualbrain.simulation.world import SimulatedWorld
from experiments.engine.experiment import Row

ERRAND = Goal("red_cube", "blue_bowl")
FORBIDDEN = ("collision_env", "collision_human", "self_collision", "collision_held", "joint_limit", "joint_velocity")
"""Kinds of violation that must not happen at all; other kinds are listed."""
GRASP = {
    "object": "red_cube", "speed": 0.2, "clearance": 0.15, "finger_axis": "along", "opening": 0.08, "approach": "top",
    "wait": "none", "force": 20.0,
}  # fmt: skip
PLACE = {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none"}


@dataclass(frozen=True, slots=True)
class Flight:
    """What a contract led to: outcome or refusal, the judgement on truth, the trace, the plant as it ended."""

    outcome: Outcome | None
    refusal: Rejected | None
    judgement: Judgement
    trace: Trace
    plant: Plant


@cache
def panda() -> Body:
    """The body, loaded once a process."""
    return load_body("panda")


def errand(**values: Any) -> list[dict[str, Any]]:
    """The actions that grasp the red cube and place it in the bowl, with `values` wherever they are parameters."""
    grasp, place = ({name: values.get(name, value) for name, value in base.items()} for base in (GRASP, PLACE))
    return [{"skill": "grasp", "params": grasp}, {"skill": "place", "params": place}]


def fly(
    spec: SceneSpec, actions: list[dict[str, Any]], *, seed: int = 0, hold: float = 0.2,
    goal: Goal | At | None = ERRAND, guard: bool = True, watch: Callable[[Moment], None] | None = None,
) -> Flight:  # fmt: skip
    """Stand still for `hold` [s], pass the gate with the scene's rules, and carry the contract out.

    The filter is on unless `guard` is False; `watch` sees a moment now and then.
    """
    body = load_body(spec.robot)
    plant = open_plant(spec, body)
    world = SimulatedWorld(plant, Perception(spec, Noise(), np.random.default_rng([seed, 1])), goal=goal)
    log = FlightLog(Trace(body.n, body.width))
    layer = LocalLayer(
        body, plant, world, SafetyFilter(body), log, LayerConfig(guard=guard), watch=watch, phase_changed=world.allow
    )
    layer.hold(hold)
    verdict = _gate(layer, actions)
    if isinstance(verdict, Rejected):
        return Flight(None, verdict, world.judgement(), log.trace, plant)
    outcome = layer.run(verdict.contract)
    return Flight(outcome, None, world.judgement(), log.trace, plant)


def _gate(layer: LocalLayer, actions: list[dict[str, Any]]):
    registry = vocabulary(layer.body.name)
    context = {"robot": registry.robot, "registry": registry.hash}
    data = msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": actions})
    gate = Gate(registry, grants(registry), scene_rules(layer.scene, layer.limb))
    return gate.check(data, names=scene_names(layer.scene), principal=PLANNER, now=layer.state.stamp)


def row(flight: Flight) -> Row:
    """The figures of a flight."""
    if flight.outcome is None:
        why = flight.refusal
        return {"valid": False, "reason": f"{why.stage} {why.pointer}: {why.hint}" if why else ""}
    delta = flight.trace["delta"]
    return {"valid": True, **outcome_figures(flight.outcome), **judgement_figures(flight.judgement),
            "delta_max": float(delta.max()), "ticks": len(delta)}  # fmt: skip


def outcome_figures(outcome: Outcome) -> Row:
    """The robot's own verdict and its Δ."""
    return {
        "outcome": outcome.kind, "reason": outcome.reason, "Delta": outcome.Delta, "Delta_sum": outcome.Delta_sum,
        "delta_peak": outcome.delta_peak, "frequency": outcome.intervention_frequency, "h_min": outcome.h_min,
        "duration": outcome.duration,
    }  # fmt: skip


def judgement_figures(judgement: Judgement | None) -> Row:
    """Success and violations on truth."""
    if judgement is None:
        return {"truth": False, "progress": 0.0, "violations": []}
    violations = msgspec.to_builtins(judgement.violations)
    return {"truth": judgement.success, "progress": judgement.progress, "violations": violations}


def succeeded(row: Row) -> bool:
    """The robot says so and truth agrees."""
    return row.get("outcome") == "succeeded" and row["truth"]


def kinds(rows: list[Row]) -> Counter[str]:
    """How many violations of each kind; those with a body that was not perceived apart."""
    return Counter(
        violation["kind"] + ("" if violation["perceived"] else " (not perceived)")
        for row in rows
        for violation in row.get("violations", ())
    )


def violation_words(row: Row) -> str:
    """Every violation of a row in words."""
    return "; ".join(
        f"{v['kind']} {' × '.join(v['bodies'])} at {v['start']:.2f} s for {v['duration']:.2f} s, peak {v['peak']:.3g}"
        + ("" if v["perceived"] else " (not perceived)")
        for v in row.get("violations", ())
    )


def outcome_words(row: Row) -> str:
    """How a row ended, for the progress line."""
    if not row.get("valid", True):
        return f"refused: {row['reason']}"
    Delta = row.get("Delta")
    measure = f"Δ {Delta:.4f}, {row['duration']:.1f} s" if Delta is not None else ""
    word = "success" if succeeded(row) else f"{row['outcome']} ({row['reason']}), truth {row['truth']}"
    return ", ".join(part for part in (word, measure, violation_words(row)) if part)
