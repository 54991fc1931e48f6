"""The planner `template`: contracts from a template with random valid parameters (no language model).

It runs the whole protocol where no model is available; results never call it a model. Object and destination are the
names of the scene that share the most words with the instruction; all other parameters are drawn from the schema, some
of them from a typical range. If memory shows an exemplar with the same skills, four of five answers copy its free
parameters: like the trained base model, the template follows examples, without knowing whether they are good.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from dualbrain.evaluation.planners.random_contract import (
    encode_contract,
    sample_params,
    seeded_rng,
    skill_parameter_schemas,
)
from dualbrain.planner.protocol import STOP
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

EXEMPLAR_FOLLOW_RATE = 0.8
"""Share of answers that copy the parameters of the first exemplar."""
TASK_PARAMETERS = ("object", "destination", "target", "place", "reason")
"""Parameters that determine the task, not its execution."""
TYPICAL_RANGES = {"opening": (0.06, 0.08), "force": (8.0, 25.0), "clearance": (0.08, 0.30), "speed": (0.1, 0.3)}
"""Ranges of numbers for which a contract usually succeeds: fingers open widely enough, a grip that holds."""
SYNONYMS = {
    "block": "cube",
    "dish": "bowl",
    "cup": "mug",
    "rack": "shelf",
    "tumbler": "glass",
    "bench": "table",
    "dock": "charger",
}
"""Colloquial words and the names that they stand for, as in the rules of the prompt."""


class TemplatePlanner:
    """Answers from a template; the same seed and request give the same answer."""

    name = "template"

    def __init__(self, seed: int = 0) -> None:
        """`seed` of all random choices."""
        self._seed = seed

    def propose(self, request: PlanRequest) -> Proposal:
        """A contract for the objects that the instruction names, or a decline."""
        rng = seeded_rng(self._seed, request.instruction, request.scene, request.contract_id, request.registry_hash)
        known = skill_parameter_schemas(request)
        actions = _drive_to(request, known, rng) if "drive_to" in known else _pick_and_place(request, known, rng)
        if not actions:
            actions = [{"skill": "decline", "params": {"reason": "the scene does not hold what is asked for"}}]
        return Proposal(
            text=encode_contract(request, actions),
            finish_reason=STOP,
            planner=self.name,
            timings={"total": 0.0},
        )

    def close(self) -> None:
        """Nothing is open."""


def _pick_and_place(request: PlanRequest, known: dict[str, Any], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Grasp the named object and place it at the named destination; empty if one of them is ambiguous."""
    if not {"grasp", "place"} <= known.keys():
        return []
    object_name = match_name(request.instruction, known["grasp"]["object"]["enum"])
    destination = match_name(request.instruction, known["place"]["destination"]["enum"])
    if object_name is None or destination is None:
        return []
    steps = [("grasp", {"object": object_name}), ("place", {"destination": destination})]
    return _fill_parameters(request, steps, known, rng)


def _drive_to(request: PlanRequest, known: dict[str, Any], rng: np.random.Generator) -> list[dict[str, Any]]:
    place = match_name(request.instruction, known["drive_to"]["place"]["enum"])
    return _fill_parameters(request, [("drive_to", {"place": place})], known, rng) if place else []


def _fill_parameters(
    request: PlanRequest, steps: list[tuple[str, dict[str, Any]]], known: dict[str, Any], rng: np.random.Generator
) -> list[dict[str, Any]]:
    """The steps with all parameters: those of the first exemplar with the same skills, or drawn ones."""
    shown = _find_exemplar(request, [skill for skill, _ in steps]) if rng.random() < EXEMPLAR_FOLLOW_RATE else None
    actions: list[dict[str, Any]] = []
    for index, (skill, named) in enumerate(steps):
        params = sample_params(restrict_to_typical_ranges(known[skill]), rng)
        copied = shown[index].get("params", {}) if shown else {}
        params |= {name: value for name, value in copied.items() if name in params and name not in TASK_PARAMETERS}
        actions.append({"skill": skill, "params": params | named})
    return actions


def _find_exemplar(request: PlanRequest, skills: list[str]) -> list[dict[str, Any]] | None:
    """The actions of the first exemplar with these skills."""
    for exemplar in request.recall.exemplars:
        actions = exemplar.contract.get("action_sequence", [])
        if [action.get("skill") for action in actions] == skills:
            return actions
    return None


def restrict_to_typical_ranges(domains: dict[str, Any]) -> dict[str, Any]:
    """The domains, narrowed to `TYPICAL_RANGES`."""
    found = dict(domains)
    for name, (low, high) in TYPICAL_RANGES.items():
        if "minimum" in found.get(name, {}):
            lower, upper = found[name]["minimum"], found[name]["maximum"]
            found[name] = {"minimum": min(max(low, lower), upper), "maximum": max(min(high, upper), lower)}
    return found


def match_name(instruction: str, names: list[str]) -> str | None:
    """The name that shares the most words with the instruction; None without a shared word, or with a tie."""
    words = {SYNONYMS.get(word, word) for word in re.findall(r"[a-z0-9]+", instruction.lower())}
    counts = sorted(((len(words & set(name.split("_"))), name) for name in names), reverse=True)
    if not counts or counts[0][0] == 0 or (len(counts) > 1 and counts[0][0] == counts[1][0]):
        return None
    return counts[0][1]
