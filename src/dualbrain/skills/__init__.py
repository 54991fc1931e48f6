"""Skills of a robot, one file each: its specification and its nominal controller φ (paper 4.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.skills.registry import SkillExecution, make_controller, skill_registry
    from dualbrain.skills.skill import (
        HeldObject,
        MotionModel,
        Nominal,
        Observation,
        PermittedContact,
        SkillResult,
        SkillRoutine,
        SkillStatus,
    )

_MODULES = {
    "skills.registry": (
        "SkillExecution",
        "make_controller",
        "skill_registry",
    ),
    "skills.skill": (
        "HeldObject",
        "MotionModel",
        "Nominal",
        "Observation",
        "PermittedContact",
        "SkillResult",
        "SkillRoutine",
        "SkillStatus",
    ),
}
"""Public names by the module that defines them."""

__all__ = [
    "HeldObject",
    "MotionModel",
    "Nominal",
    "Observation",
    "PermittedContact",
    "SkillExecution",
    "SkillResult",
    "SkillRoutine",
    "SkillStatus",
    "make_controller",
    "skill_registry",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
