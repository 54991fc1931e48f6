"""The answer of a planner on the terminal while it is generated.

The text is incomplete and unchecked, and it comes from a model: only skills and names are shown, and nothing else is
done with it.
"""

from __future__ import annotations

import re

from dualbrain.cli.common.spinner import Spinner

_ACTION = re.compile(r'"skill":"([A-Za-z0-9_]{1,48})"(?:,"params":\{"[a-z_]{1,48}":"([A-Za-z0-9_-]{1,48})")?')
"""A skill, and its first parameter if that is a name."""


class AnswerDisplay:
    """Shows the skills of a growing answer beside `spinner`, as soon as their first name is known."""

    def __init__(self, spinner: Spinner) -> None:
        """Show nothing until the first call."""
        self._spinner = spinner
        self._shown: list[str] = []

    def __call__(self, text: str) -> None:
        """Show the skills in `text`, the answer so far."""
        skills = describe_partial_answer(text)
        if skills != self._shown:
            self._shown = skills
            self._spinner.add(", ".join(skills))


def describe_partial_answer(text: str) -> list[str]:
    """The skills in the incomplete contract `text`, such as "grasp red_cube"; the last one only if it is certain."""
    found = list(_ACTION.finditer(text))
    if found and found[-1][2] is None and not text[found[-1].end() :].startswith(',"params":{"'):
        found.pop()
    return [" ".join(filter(None, one.groups())) for one in found]
