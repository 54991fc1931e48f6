"""Random contracts: each parameter is drawn from its domain in a decoding schema, independent of the others."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec
import numpy as np

from dualbrain.contracts.schema import step_schemas
from dualbrain.planner.request import PlanRequest

DECIMALS = 3
"""Decimal places of a drawn number."""


def seeded_rng(seed: int, *words: str) -> np.random.Generator:
    """A random generator that depends on `seed` and `words` alone."""
    digest = hashlib.sha256("\0".join(words).encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])


def skill_parameter_schemas(request: PlanRequest) -> dict[str, dict[str, Any]]:
    """For each skill that can be called in the scene, the schema of each parameter by itself.

    If the schema divides the domain of a skill into parts, a parameter has the union of them.
    """
    steps = (step["properties"] for step in step_schemas(request.schema))
    return {step["skill"]["const"]: _parameter_domains(step["params"]) for step in steps}


def _parameter_domains(params: dict[str, Any]) -> dict[str, Any]:
    """The domain of each parameter in the schema `params`, over all its alternatives."""
    parts = [part["properties"] for part in params.get("anyOf", [params])]
    return {name: _union([part[name] for part in parts]) for name in parts[0]}


def _union(domains: list[dict[str, Any]]) -> dict[str, Any]:
    """The union of domains of one parameter, which differ in names or choices and in their bounds only."""
    union = dict(domains[0])
    if "enum" in union:
        union["enum"] = list(dict.fromkeys(value for domain in domains for value in domain["enum"]))
    if "minimum" in union:
        union["minimum"] = min(domain["minimum"] for domain in domains)
    return union


def sample_value(domain: dict[str, Any], rng: np.random.Generator) -> float | str:
    """A value of `domain`, drawn uniformly; text without choices is a fixed sentence."""
    if "enum" in domain:
        return str(domain["enum"][int(rng.integers(len(domain["enum"])))])
    if "minimum" in domain:
        low, high = float(domain["minimum"]), float(domain["maximum"])
        return min(max(round(float(rng.uniform(low, high)), DECIMALS), low), high)
    return "no reason is given"


def sample_params(domains: dict[str, Any], rng: np.random.Generator) -> dict[str, float | str]:
    """Drawn values for all parameters of a skill."""
    return {name: sample_value(domain, rng) for name, domain in domains.items()}


def encode_contract(request: PlanRequest, actions: list[dict[str, Any]], *, registry: str = "") -> str:
    """A contract with `actions`, as a planner writes it."""
    context = {"robot": request.robot, "registry": registry or request.registry_hash}
    contract = {"id": request.contract_id, "context": context, "action_sequence": actions}
    return msgspec.json.encode(contract).decode()
