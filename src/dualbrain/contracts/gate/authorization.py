"""Authorization stage of the gate (paper 3.3): robot, registry, granted skills, and the header against replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import closest_name_hint, json_pointer, to_printable

PLANNER = "planner"
"""Principal of all planners."""


class AuthorizationStage:
    """Checks that a principal may call the skills of a contract; a skill that is not granted is refused.

    Raises `UnknownNameError` if a grant names a skill that is not registered.
    """

    def __init__(self, registry: SkillRegistry, grants: Mapping[str, frozenset[str]]) -> None:
        """Use `grants`, the skills of each principal."""
        for skill in sorted(frozenset[str]().union(*grants.values())):
            registry.skill(skill)
        self._registry, self._grants = registry, dict(grants)
        self._robot, self._hash, self._skills = registry.robot, registry.hash, frozenset(registry.by_name)

    def check(self, document: Any, principal: str) -> Rejected | None:
        """None if the well-formed `document` is for this robot and registry and calls only granted skills."""
        context = document["context"]
        if context["robot"] != self._robot:
            return _reject(
                json_pointer("context", "robot"), context["robot"], self._robot, "this gate guards another robot"
            )
        if context["registry"] != self._hash:
            hint = "written for other skills, units or bounds: plan again with the current registry"
            return _reject(json_pointer("context", "registry"), context["registry"], self._hash, hint)
        granted = self._grants.get(principal)
        if granted is None:
            return _reject("", principal, sorted(self._grants), "this principal holds no grant")
        for index, step in enumerate(document["action_sequence"]):
            if step["skill"] not in granted:
                return self._reject_skill(index, step["skill"], granted)
        return None

    def _reject_skill(self, index: int, skill: str, granted: frozenset[str]) -> Rejected:
        """The rejection of a skill that is not registered, or is registered but not granted."""
        known = tuple(name for name in self._registry.by_name if name in granted)
        hint = "registered, but not granted to this principal"
        if skill not in self._skills:
            hint = f"not a registered skill; {closest_name_hint(skill, known)}"
        return _reject(json_pointer("action_sequence", index, "skill"), skill, list(known), hint)


def check_header(
    header: ContractHeader, *, principal: str, now: float, names: SceneNames, last_sequence: int | None
) -> Rejected | None:
    """None if `header` names `principal`, is valid at `now` [s], is newer than `last_sequence`, and fits the scene.

    The comparisons are written so that NaN in any time leads to a rejection.
    """
    if header.principal != principal:
        return _reject("", header.principal, principal, "stamped for another principal")
    if not header.issued <= now:
        return _reject("", f"issued {header.issued} s", f"issued by {now} s", "from the future: check the clocks")
    if not now < header.expires:
        return _reject("", f"expires {header.expires} s", f"after {now} s", "expired: plan again on the scene of now")
    if last_sequence is not None and not header.sequence > last_sequence:
        return _reject(
            "", f"sequence {header.sequence}", f"above {last_sequence}", "already used: replayed or out of order"
        )
    if names.version is not None and header.scene_version != names.version:
        got, allowed = f"scene version {header.scene_version}", f"scene version {names.version}"
        return _reject("", got, allowed, "things came or went since: plan again")
    return None


def _reject(pointer: str, got: object, allowed: object, hint: str) -> Rejected:
    """A rejection at this stage."""
    return Rejected(stage="authorization", pointer=pointer, got=to_printable(got), allowed=allowed, hint=hint)
