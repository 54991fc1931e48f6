"""Task templates: contracts with slots, shown to a planner only if the gate accepts them with filled slots."""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal

import msgspec

from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import NameKind, SceneNames
from dualbrain.contracts.verdict import Rejected

_SLOT = re.compile(r"\{([a-z][a-z0-9_]{0,31})\}")
_TEMPLATE_PRINCIPAL = "template"
"""Principal for checking a template; it has every grant, and nothing is executed."""


class TemplateStep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One action; a parameter "{slot}" represents a name in the scene."""

    skill: str
    params: dict[str, float | str]


class Template(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A contract with slots: its use, the kind of names for each slot (`slots`), and its actions."""

    name: Annotated[str, msgspec.Meta(pattern="^[a-z][a-z0-9_]{0,31}$")]
    use_when: Annotated[str, msgspec.Meta(max_length=300)]
    slots: dict[str, NameKind]
    action_sequence: Annotated[tuple[TemplateStep, ...], msgspec.Meta(min_length=1, max_length=8)]

    def __post_init__(self) -> None:
        """Raise `ValueError` unless exactly the declared slots are used."""
        used = {slot for step in self.action_sequence for value in step.params.values() for slot in _slot_names(value)}
        if used != self.slots.keys():
            raise ValueError(f"template {self.name!r}: slots {sorted(self.slots)}, but {sorted(used)} are used")

    def fill_slots(self, names: dict[str, str]) -> list[dict[str, Any]]:
        """The action sequence with the slots replaced by `names` (slot → name in the scene)."""

        def fill(value: float | str) -> float | str:
            slot = _slot_names(value)
            return names[slot[0]] if slot else value

        return [
            {"skill": step.skill, "params": {name: fill(value) for name, value in step.params.items()}}
            for step in self.action_sequence
        ]

    def prompt_text(self) -> str:
        """Text for a prompt: the use of the template, and its actions as one line of JSON."""
        actions = json.dumps(msgspec.to_builtins(self.action_sequence), separators=(",", ":"))
        return f"{self.use_when} {actions}"


class TaskTemplates(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A document with templates for the robots that it names."""

    kind: Literal["template"]
    title: Annotated[str, msgspec.Meta(max_length=200)]
    robots: Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=20)]
    templates: Annotated[tuple[Template, ...], msgspec.Meta(min_length=1, max_length=50)]
    about: Annotated[str, msgspec.Meta(max_length=400)] = ""


def check_template(template: Template, registry: SkillRegistry) -> Rejected | None:
    """The gate's rejection of `template` for `registry` with a placeholder in each slot; None if it is accepted.

    All three stages of the gate check a complete contract. Properties of a real scene (reach, state of the gripper) are
    checked when a contract from this template reaches the gate, like any other contract.
    """
    placeholder = {slot: f"any_{slot}" for slot in template.slots}
    graspable = tuple(placeholder[slot] for slot, kind in template.slots.items() if kind in {"graspable", "any"})
    receptive = tuple(placeholder[slot] for slot, kind in template.slots.items() if kind == "receptive")
    context = {"robot": registry.robot, "registry": registry.hash}
    contract = {"id": "c-0001", "context": context, "action_sequence": template.fill_slots(placeholder)}
    gate = Gate(registry, {_TEMPLATE_PRINCIPAL: frozenset(registry.by_name)})
    verdict = gate.check(
        json.dumps(contract).encode(), names=SceneNames(graspable, receptive), principal=_TEMPLATE_PRINCIPAL, now=0.0
    )
    return verdict if isinstance(verdict, Rejected) else None


def _slot_names(value: float | str) -> list[str]:
    match = _SLOT.fullmatch(value) if isinstance(value, str) else None
    return [match[1]] if match else []
