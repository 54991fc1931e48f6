"""Stage two: may this be asked, of this robot, by this principal, now? (paper 3.3; age and replay by the stamp)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dualbrain.contracts.contract import Stamp
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import closest, pointer, shown

PLANNER = "planner"
"""The principal under which every planner acts."""


class AuthorizationStage:
    """Which principal may call which registered skill; anything not granted is refused.

    Raises `UnknownName` when a grant names a skill that is not registered.
    """

    def __init__(self, registry: Registry, grants: Mapping[str, frozenset[str]]) -> None:
        """Hold `grants`: principal → skills."""
        for skill in sorted(frozenset[str]().union(*grants.values())):
            registry.skill(skill)
        self._registry, self._grants = registry, dict(grants)
        self._robot, self._hash, self._skills = registry.robot, registry.hash, frozenset(registry.by_name)

    def check(self, document: Any, principal: str) -> Rejected | None:
        """None if the well-formed `document` is for our robot and registry and calls only granted skills."""
        context = document["context"]
        if context["robot"] != self._robot:
            return _no(pointer("context", "robot"), context["robot"], self._robot, "this gate guards another robot")
        if context["registry"] != self._hash:
            hint = "written for other skills, units or bounds: plan again with the current registry"
            return _no(pointer("context", "registry"), context["registry"], self._hash, hint)
        granted = self._grants.get(principal)
        if granted is None:
            return _no("", principal, sorted(self._grants), "this principal holds no grant")
        for index, step in enumerate(document["action_sequence"]):
            if step["skill"] not in granted:
                return self._unskilled(index, step["skill"], granted)
        return None

    def _unskilled(self, index: int, skill: str, granted: frozenset[str]) -> Rejected:
        """The refusal of a skill that is not registered, or registered but not granted."""
        known = tuple(name for name in self._registry.by_name if name in granted)
        hint = "registered, but not granted to this principal"
        if skill not in self._skills:
            hint = f"not a registered skill; {closest(skill, known)}"
        return _no(pointer("action_sequence", index, "skill"), skill, list(known), hint)


def check_stamp(stamp: Stamp, *, principal: str, now: float, names: SceneNames, last: int | None) -> Rejected | None:
    """None if `stamp` is this principal's, in time, newer than `last` accepted, and made for this scene version.

    Written so that NaN in any time takes the refusing branch.
    """
    if stamp.principal != principal:
        return _no("", stamp.principal, principal, "stamped for another principal")
    if not stamp.issued <= now:
        return _no("", f"issued {stamp.issued} s", f"issued by {now} s", "from the future: check the clocks")
    if not now < stamp.expires:
        return _no("", f"expires {stamp.expires} s", f"after {now} s", "expired: plan again on the scene of now")
    if last is not None and not stamp.sequence > last:
        return _no("", f"sequence {stamp.sequence}", f"above {last}", "already used: replayed or out of order")
    if names.version is not None and stamp.scene_version != names.version:
        got, allowed = f"scene version {stamp.scene_version}", f"scene version {names.version}"
        return _no("", got, allowed, "things came or went since: plan again")
    return None


def _no(place: str, got: object, allowed: object, hint: str) -> Rejected:
    """A refusal at this stage."""
    return Rejected("authorization", place, shown(got), allowed, hint)
