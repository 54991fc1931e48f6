"""What sets two accounts of the same kind apart, in words."""

from __future__ import annotations

from collections.abc import Mapping


def apart(there: Mapping[str, object], here: Mapping[str, object]) -> str:
    """Each part of which both tell, and not the same; "" if there is none."""
    found = [(name, value, here[name]) for name, value in there.items() if here.get(name, value) != value]
    return "; ".join(f"{name} {theirs}, now {ours}" for name, theirs, ours in found)
