"""The one text of a contract: what a planner is taught to write, and what a constrained decoder can reach.

Keys stand in the order of the decoding schema (id, context, steps; parameters as registered), nothing else stands
between them, and numbers are written as in RFC 8785. It is not the RFC 8785 form of the whole: there keys are sorted,
so `params` would come before `skill` and a model would write values before it knows of what.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from dualbrain.contracts.canonical import canonical_json
from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.registry import Registry


def canonical_contract(contract: Contract, registry: Registry) -> str:
    """`contract` in its one text, ASCII on one line; parameters that `registry` does not know come last, by name.

    Law: two contracts have the same text exactly if they say the same, whatever order or notation they came in; reading
    the text gives the contract back. Raises `UnknownName` for a skill that is not registered.
    """
    context = _object({"robot": contract.context.robot, "registry": contract.context.registry})
    steps = ",".join(_step(action, registry) for action in contract.action_sequence)
    return f'{{"id":{_leaf(contract.id)},"context":{context},"action_sequence":[{steps}]}}'


def _step(action: Action, registry: Registry) -> str:
    order = [parameter.name for parameter in registry.skill(action.skill).parameters]
    known = {name: action.params[name] for name in order if name in action.params}
    rest = {name: action.params[name] for name in sorted(action.params) if name not in known}
    return f'{{"skill":{_leaf(action.skill)},"params":{_object(known | rest)}}}'


def _object(members: Mapping[str, Any]) -> str:
    return "{" + ",".join(f"{_leaf(name)}:{_leaf(value)}" for name, value in members.items()) + "}"


def _leaf(value: Any) -> str:
    return json.dumps(value) if isinstance(value, str) else canonical_json(value).decode()
