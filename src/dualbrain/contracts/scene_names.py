"""Names of scene objects and places that a contract may use in the current scene."""

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
    """Names of graspable objects, and of containers and places that can receive an object.

    A name is an identifier, so that free text in the scene cannot enter the prompt as a name. If `version`, the version
    of the scene, is given, the authorization stage rejects a header that was made for another version.

    Raises:
        ConfigurationError: A name is not an identifier.
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
        """Every name once, graspable objects first."""
        return tuple(dict.fromkeys(self.graspable + self.receptive))

    def names_of_kind(self, kind: NameKind) -> tuple[str, ...]:
        """The names that a `NameParameter` whose `of` is `kind` may take."""
        if kind == "any":
            return self.all_names
        return self.graspable if kind == "graspable" else self.receptive
