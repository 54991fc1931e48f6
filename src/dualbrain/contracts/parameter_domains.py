"""Parts of a skill's parameter domain that the rules of a robot can accept in a scene, for constrained decoders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class ParameterDomain:
    """A part of the parameter domain of one skill; a parameter without an entry keeps its whole domain.

    `admitted` contains the admitted names or choices of a parameter, and `least` and `most` the lower and the upper
    bound of a number in the unit of the parameter.
    """

    admitted: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    least: Mapping[str, float] = field(default_factory=dict[str, float])
    most: Mapping[str, float] = field(default_factory=dict[str, float])


ParameterDomains = Mapping[str, Sequence[ParameterDomain]]
"""The domain of each skill as the union of its parts; a skill without an entry keeps its whole domain."""
