"""Which names of scene objects and places a contract may use just now."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from dualbrain.errors import ConfigurationError

NameKind = Literal["graspable", "receptive", "any"]

_NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,47}")


@dataclass(frozen=True)
class SceneNames:
    """Names of the things that may be grasped and of the containers and places that may receive.

    A name is an identifier, never prose: text seen in the scene cannot reach the prompt as a name. `version` is the
    scene's version; where it is given, a stamp made for another version is refused at authorization.
    """

    graspable: tuple[str, ...] = ()
    receptive: tuple[str, ...] = ()
    version: int | None = None

    def __post_init__(self) -> None:
        for name in self.graspable + self.receptive:
            if not _NAME_PATTERN.fullmatch(name):
                raise ConfigurationError("scene name", got=name[:80], allowed=f"identifiers, {_NAME_PATTERN.pattern}")

    @cached_property
    def all_names(self) -> tuple[str, ...]:
        """Every name once: graspable ones first."""
        return tuple(dict.fromkeys(self.graspable + self.receptive))

    def names_of_kind(self, kind: NameKind) -> tuple[str, ...]:
        """The names that a `Name` parameter with this `of` may take."""
        if kind == "any":
            return self.all_names
        return self.graspable if kind == "graspable" else self.receptive
