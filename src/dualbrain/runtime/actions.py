"""Actions of a contract: what each is about, in words, and what is said of one that never began."""

from __future__ import annotations

from dualbrain.contracts.contract import Action
from dualbrain.records import ActionResult
from dualbrain.skills.skill import Holding


def roles_of(action: Action, holding: Holding | None) -> dict[str, str | None]:
    """What the action is about: its target and its destination, by name."""
    params = action.params
    target = params.get("object") or params.get("target") or (holding.name if holding else None)
    destination = params.get("destination")
    return {"target": str(target) if target else None, "destination": str(destination) if destination else None}


def in_words(action: Action) -> str:
    """Its parameters, for the log."""
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in action.params.items()
    )


def not_run(action: Action) -> ActionResult:
    """What is said of an action that never began."""
    return ActionResult(action.skill, "not_run", "an earlier action did not succeed", 0.0, 0.0, 0.0)
