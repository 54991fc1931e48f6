"""The growing answer of a planner on the terminal: whole skills only, and nothing of its free text."""

import io
from itertools import pairwise

import pytest
from rich.console import Console

from dualbrain.cli.common.answer_display import AnswerDisplay, describe_partial_answer
from dualbrain.cli.common.spinner import Spinner

ANSWER = (
    '{"id":"c-0001","action_sequence":[{"skill":"grasp","params":{"object":"red_cube","speed":0.2}},'
    '{"skill":"home","params":{"speed":0.2}},{"skill":"decline","params":{"reason":"[bold]no\\u001b way"}}]}'
)
SKILLS = ["grasp red_cube", "home", "decline"]


def test_every_beginning_shows_a_beginning_of_the_skills():
    shown = [describe_partial_answer(ANSWER[:length]) for length in range(len(ANSWER) + 1)]
    assert shown[0] == []
    assert shown[-1] == SKILLS
    for before, after in pairwise(shown):
        assert before in (after, after[:-1], [*after[:-1], after[-1].split()[0]] if after else [])
    assert ["grasp red_cube"] in shown


@pytest.mark.parametrize("terminal", [False, True])
def test_each_new_skill_is_shown_once(terminal):
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=120, legacy_windows=False)
    with Spinner(console, "planning (a [model])") as spinner:
        display = AnswerDisplay(spinner)
        for length in range(len(ANSWER) + 1):
            display(ANSWER[:length])
    text = out.getvalue()
    assert "planning (a [model])" in text
    assert "\x1b way" not in text
    if not terminal:
        assert text.count("grasp red_cube, home\n") == 1
        assert len(text.splitlines()) <= 1 + 2 * len(SKILLS)
