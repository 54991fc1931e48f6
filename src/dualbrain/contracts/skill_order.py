"""The orders of skills that a robot's rules can accept, as a finite automaton for constrained decoders."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SkillOrder:
    """An automaton over skills: `following[state][skill]` is the state after `skill`.

    A skill that is absent there is refused in that state. Every state may end the sequence.
    """

    start: str
    following: Mapping[str, Mapping[str, str]]

    def admits(self, skills: Iterable[str]) -> bool:
        """Whether the sequence of `skills` follows the automaton."""
        state: str | None = self.start
        for skill in skills:
            state = self.following[state].get(skill)
            if state is None:
                return False
        return True

    def reaches(self, skills: Collection[str], length: int) -> bool:
        """Whether there is a sequence of `length` of the given `skills` alone."""
        states = {self.start}
        for _ in range(length):
            states = {after for state in states for skill, after in self.following[state].items() if skill in skills}
        return bool(states)

    def as_json(self) -> dict[str, object]:
        """The value of the keyword `x-order` of a decoding schema."""
        return {"start": self.start, "following": {state: dict(steps) for state, steps in self.following.items()}}
