"""Task templates: contracts with slots, shown to a planner only if the gate itself would accept them once filled."""

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
"""The principal under which a template is looked at; it holds every grant, and nothing is run."""


class TemplateStep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One action; a parameter that is "{slot}" stands for a name of the scene."""

    skill: str
    params: dict[str, float | str]


class Template(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A contract skeleton: when to use it, its `slots` (slot → which names may stand there) and its actions."""

    name: Annotated[str, msgspec.Meta(pattern="^[a-z][a-z0-9_]{0,31}$")]
    use_when: Annotated[str, msgspec.Meta(max_length=300)]
    slots: dict[str, NameKind]
    action_sequence: Annotated[tuple[TemplateStep, ...], msgspec.Meta(min_length=1, max_length=8)]

    def __post_init__(self) -> None:
        """Raise ValueError unless the slots that are declared are those that are used."""
        used = {slot for step in self.action_sequence for value in step.params.values() for slot in _slot_names(value)}
        if used != self.slots.keys():
            raise ValueError(f"template {self.name!r}: slots {sorted(self.slots)}, but {sorted(used)} are used")

    def fill_slots(self, names: dict[str, str]) -> list[dict[str, Any]]:
        """The action sequence with `names` (slot → name of the scene) in place of the slots."""

        def fill(value: float | str) -> float | str:
            slot = _slot_names(value)
            return names[slot[0]] if slot else value

        return [
            {"skill": step.skill, "params": {name: fill(value) for name, value in step.params.items()}}
            for step in self.action_sequence
        ]

    def prompt_text(self) -> str:
        """For a prompt: when to use it, and the skeleton as one line of JSON."""
        skeleton = json.dumps(msgspec.to_builtins(self.action_sequence), separators=(",", ":"))
        return f"{self.use_when} {skeleton}"


class TaskTemplates(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A document of templates for the robots it names."""

    kind: Literal["template"]
    title: Annotated[str, msgspec.Meta(max_length=200)]
    robots: Annotated[tuple[str, ...], msgspec.Meta(min_length=1, max_length=20)]
    templates: Annotated[tuple[Template, ...], msgspec.Meta(min_length=1, max_length=50)]
    about: Annotated[str, msgspec.Meta(max_length=400)] = ""


def check_template(template: Template, registry: SkillRegistry) -> Rejected | None:
    """What the gate says of `template` for `registry`, with a made-up name in each slot; None: it would be accepted.

    All three stages run on a whole contract. What needs a real scene (reach, the hand's state) is judged when a
    contract made from it comes to the real gate, like any other.
    """
    stand_in = {slot: f"any_{slot}" for slot in template.slots}
    graspable = tuple(stand_in[slot] for slot, of in template.slots.items() if of in {"graspable", "any"})
    receptive = tuple(stand_in[slot] for slot, of in template.slots.items() if of == "receptive")
    context = {"robot": registry.robot, "registry": registry.hash}
    contract = {"id": "c-0001", "context": context, "action_sequence": template.fill_slots(stand_in)}
    gate = Gate(registry, {_TEMPLATE_PRINCIPAL: frozenset(registry.by_name)})
    verdict = gate.check(
        json.dumps(contract).encode(), names=SceneNames(graspable, receptive), principal=_TEMPLATE_PRINCIPAL, now=0.0
    )
    return verdict if isinstance(verdict, Rejected) else None


def _slot_names(value: float | str) -> list[str]:
    match = _SLOT.fullmatch(value) if isinstance(value, str) else None
    return [match[1]] if match else []
