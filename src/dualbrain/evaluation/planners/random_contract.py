"""Random values from a contract's decoding schema: valid by construction, chosen by chance alone."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec
import numpy as np

from dualbrain.planner.request import PlanRequest

DECIMALS = 3
"""Digits after the point of a drawn number, as a person would write it."""


def seeded_rng(seed: int, *words: str) -> np.random.Generator:
    """A generator that depends on `seed` and `words` alone."""
    digest = hashlib.sha256("\0".join(words).encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])


def skill_parameter_schemas(request: PlanRequest) -> dict[str, dict[str, Any]]:
    """The schema of the parameters of each skill that can be called in this scene."""
    steps = request.schema["properties"]["action_sequence"]["items"].get("anyOf", [])
    return {step["properties"]["skill"]["const"]: step["properties"]["params"]["properties"] for step in steps}


def sample_value(domain: dict[str, Any], rng: np.random.Generator) -> float | str:
    """One value of `domain`, uniform."""
    if "enum" in domain:
        return str(domain["enum"][int(rng.integers(len(domain["enum"])))])
    if "minimum" in domain:
        low, high = float(domain["minimum"]), float(domain["maximum"])
        return min(max(round(float(rng.uniform(low, high)), DECIMALS), low), high)
    return "no reason is given"


def sample_params(domains: dict[str, Any], rng: np.random.Generator) -> dict[str, float | str]:
    """Values for all parameters of a skill."""
    return {name: sample_value(domain, rng) for name, domain in domains.items()}


def encode_contract(request: PlanRequest, actions: list[dict[str, Any]], *, registry: str = "") -> str:
    """The contract of `actions` as a planner writes it."""
    context = {"robot": request.robot, "registry": registry or request.registry_hash}
    contract = {"id": request.contract_id, "context": context, "action_sequence": actions}
    return msgspec.json.encode(contract).decode()
