"""The sentence of the demonstration in new scenes: success, and end states that one more skill could resolve."""

from __future__ import annotations

from typing import Any

import msgspec

from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.evaluation.instructed_run import instructed_row, open_named_planner, planners_of, run_instruction
from experiments.evaluation.instructions.final_state import FinalState
from experiments.figures.tables import format_share_by_scene, markdown_table
from experiments.safety.closed_loop import describe_outcome

FIRST_SCENE, N_SCENES = 80_000, 100
"""Numbered scenes: four families in turn, with seeds that no other experiment uses."""
WORDINGS = (
    "put the red cube in the bowl",
    "Would you be so kind and get the little red cube into the blue bowl?",
    "the red cube should not stay on the table, the bowl is the right place for it",
)
GOAL, OBJECT = "put red_cube in blue_bowl", "red_cube"
FULL_HAND_PHRASES = ("hand is full", "already holds", "holds red_cube", "is held")
"""Parts of refusals because the hand is full."""
MIN_SUCCESS_SHARE = 0.95


class DemoSentence:
    """The demonstration in 100 scenes, three wordings, every packaged planner."""

    name = "demo_sentence"
    intervals = "over scenes (bootstrap; Korn and Graubard for rare events), 95 %"
    claim = (
        f"Of {N_SCENES} new scenes × {len(WORDINGS)} wordings with each packaged planner, at least "
        f"{MIN_SUCCESS_SHARE:.0%} succeed on ground truth, and no run ends in a state that one skill could resolve."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Wording by wording, scenes and planners in turn; `--planner packaged` for all packaged planners."""
        return [
            WorkUnit(
                f"scene {scene} wording {wording} {planner}", {"scene": scene, "wording": wording, "planner": planner}
            )
            for wording in range(len(WORDINGS))
            for scene in range(FIRST_SCENE, FIRST_SCENE + N_SCENES)
            for planner in planners_of(options.planner)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the sentence on a Panda."""
        planner = open_named_planner(parameters["planner"], "panda")
        if planner is None:
            return {**parameters, "available": False}
        run = run_instruction(WORDINGS[parameters["wording"]], "panda", str(parameters["scene"]), planner, goal=GOAL)
        return {**parameters, "available": True, "family": run.spec.family, **instructed_row(run)}

    def summarize_row(self, row: Row) -> str:
        """Family, outcome, and the end state if one skill could resolve it."""
        if not row["available"]:
            return "the planner is not available for this robot"
        return f"{row['family']}: {describe_outcome(row)} {resolvable_end(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """Success by planner and family, end states, and every run without success."""
        rows = [row for row in rows if row["available"]]
        lines: list[str] = []
        for planner in sorted({row["planner"] for row in rows}):
            some = [row for row in rows if row["planner"] == planner]
            ends = [(str(row["scene"]), bool(resolvable_end(row))) for row in some]
            lines += [
                f"{planner}: succeeded on ground truth **{_success_share(some)}**, in "
                f"{len({row['scene'] for row in some})} scenes. Ended in a state that one skill could resolve: "
                f"{format_share_by_scene(ends)}.",
                "",
                *_group_table(some),
            ]
        failed = [row for row in rows if not row["truth"]]
        cells = (
            (row["key"], row["family"], f"{row['outcome']}: {row['reason']}", resolvable_end(row)) for row in failed
        )
        return lines + (markdown_table(("run", "family", "the robot reports", "end"), cells) if failed else [])


def resolvable_end(row: Row) -> str:
    """The end state that one skill could resolve, "" for another one.

    `held`: both fingers hold the object, so that `place` would finish the task. `refused, hand full`: an answer was
    refused because the hand is full.
    """
    if row["truth"]:
        return ""
    state = msgspec.convert(row["state"], FinalState)
    if state.objects[OBJECT].fingers == 2:
        return "held"
    return "refused, hand full" if any(phrase in row["text"] for phrase in FULL_HAND_PHRASES) else ""


def _success_share(rows: list[Row]) -> str:
    return format_share_by_scene([(str(row["scene"]), bool(row["truth"])) for row in rows])


def _group_table(rows: list[Row]) -> list[str]:
    groups = [
        (family, [row for row in rows if row["family"] == family]) for family in sorted({r["family"] for r in rows})
    ]
    groups += [(f"“{text}”", [row for row in rows if row["wording"] == k]) for k, text in enumerate(WORDINGS)]
    cells = ((label, _success_share(some)) for label, some in groups if some)
    return markdown_table(("", "succeeded"), cells)
