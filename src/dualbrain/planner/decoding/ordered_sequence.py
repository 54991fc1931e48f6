"""Grammar rules for an action sequence whose skills follow an automaton (`contracts/skill_order.py`).

A JSON schema restricts each position of an array by itself. The rules here have one nonterminal for each state of the
automaton and each number of actions before it: at most 8 actions in few states, so some twenty rules.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(slots=True, kw_only=True)
class OrderedSequence:
    """An array of `least` to `most` actions; `order` is the automaton in the form of `SkillOrder.as_json`.

    `steps` maps each skill to the nonterminal of its action; skills without one are left out.
    """

    name: str
    steps: Mapping[str, str]
    order: Mapping[str, Any]
    least: int
    most: int
    rules: dict[str, str] = field(default_factory=dict[str, str])

    def grammar(self) -> str:
        """The rules, one a line; the first one defines `name`. "" if the automaton admits no sequence."""
        first = self._actions(self.order["start"], 0)
        lines = [f'{self.name}: "[" {first} "]"', *(f"{rule}: {body}" for rule, body in self.rules.items())]
        return "\n".join(lines) if first else ""

    def _actions(self, state: str, before: int) -> str:
        """The nonterminal for the actions from `state` on, with `before` actions before them; "" if there are none."""
        rule = f"{self.name}_{state}_{before}"
        if rule not in self.rules and before < self.most:
            by_next = defaultdict[str, list[str]](list)
            for skill, following in self.order["following"][state].items():
                if skill in self.steps:
                    by_next[following].append(self.steps[skill])
            ends = {following: self._end(following, before + 1) for following in by_next}
            ways = [
                f"({' | '.join(steps)}){end}"
                for following, steps in by_next.items()
                if (end := ends[following]) is not None
            ]
            self.rules[rule] = " | ".join(ways)
        return rule if self.rules.get(rule) else ""

    def _end(self, state: str, done: int) -> str | None:
        """The text after an action: nothing, or a comma and further actions; None if neither is admitted."""
        further = self._actions(state, done)
        more = f' ("," {further})' if further else ""
        if done < self.least:
            return more or None
        return f"{more}?" if more else ""
