"""Canonical text of a contract: the form that planners are trained to write and that constrained decoders can reach.

Keys are in the order of the decoding schema (id, context, steps; parameters as registered), without white space, and
numbers are written as in RFC 8785. The text as a whole is not in RFC 8785 form, which sorts the keys: `params` would
come before `skill`, and a model would have to write the values before the name of the skill.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

from dualbrain.contracts.canonical_json import canonical_json
from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import SkillSpec


def canonical_contract(contract: Contract, registry: SkillRegistry) -> str:
    """The canonical text of `contract`, ASCII on one line; parameters unknown to `registry` come last, by name.

    Law: two contracts have the same text exactly if they are equal, in any order and notation of their source; decoding
    the text gives the contract. Raises `UnknownNameError` for a skill that is not registered.
    """
    context = _encode_object({"robot": contract.context.robot, "registry": contract.context.registry})
    steps = ",".join(_encode_step(action, registry) for action in contract.action_sequence)
    return f'{{"id":{_encode_leaf(contract.id)},"context":{context},"action_sequence":[{steps}]}}'


def reorder_contract(contract: Mapping[str, Any], registry: SkillRegistry) -> dict[str, Any]:
    """The decoded JSON `contract` with its steps and their parameters in the order of the canonical text.

    Nothing is checked or dropped: unknown members come last, by name, and a malformed step is returned unchanged.
    """
    context: Any = contract.get("context")
    steps: Any = contract.get("action_sequence")
    ordered: dict[str, Any] = {}
    if isinstance(context, dict):
        ordered["context"] = _put_first(cast("dict[str, Any]", context), ("robot", "registry"))
    if isinstance(steps, list | tuple):
        ordered["action_sequence"] = [_reorder_step(step, registry.by_name) for step in cast("Sequence[Any]", steps)]
    return _put_first({**contract, **ordered}, ("id", "context", "action_sequence"))


def _put_first(members: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """`members` with those called `names` first, in that order, and the others sorted by name."""
    known = {name: members[name] for name in names if name in members}
    return known | {name: members[name] for name in sorted(members) if name not in known}


def _reorder_step(step: Any, known: Mapping[str, SkillSpec]) -> Any:
    """`step` with its skill first and its parameters as registered."""
    if not isinstance(step, dict):
        return step
    members = cast("dict[str, Any]", step)
    skill, params = members.get("skill"), members.get("params")
    if not isinstance(skill, str) or skill not in known or not isinstance(params, dict):
        return members
    ordered = {"skill": skill, "params": _reorder_params(cast("dict[str, Any]", params), known[skill])}
    return _put_first(members | ordered, ordered)


def _encode_step(action: Action, registry: SkillRegistry) -> str:
    params = _reorder_params(action.params, registry.skill(action.skill))
    return f'{{"skill":{_encode_leaf(action.skill)},"params":{_encode_object(params)}}}'


def _reorder_params(params: Mapping[str, Any], skill: SkillSpec) -> dict[str, Any]:
    return _put_first(params, (parameter.name for parameter in skill.parameters))


def _encode_object(members: Mapping[str, Any]) -> str:
    return "{" + ",".join(f"{_encode_leaf(name)}:{_encode_leaf(value)}" for name, value in members.items()) + "}"


def _encode_leaf(value: Any) -> str:
    return json.dumps(value) if isinstance(value, str) else canonical_json(value).decode()
