"""Free instructions: whether the robot carries them out, or declines for the right reason."""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgspec

from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.evaluation.instructed_run import instructed_row, open_named_planner, planners_of, run_instruction
from experiments.evaluation.instructions.final_state import FinalState
from experiments.evaluation.instructions.instruction_set import (
    FREE_FILES,
    FreeInstruction,
    content_hash,
    free_instructions,
)
from experiments.evaluation.instructions.judgement import ANSWER_CLASSES, AnswerJudgement, judge_answer
from experiments.figures.tables import format_proportion, markdown_table

MIN_RIGHT_SHARE = 0.8
HELD_OUT = frozenset({"second", "third", "fourth"})
"""The sets whose errors are counted and not listed."""


class FreeInstructionsExperiment:
    """Free instructions with outcomes that were written beforehand."""

    name = "free_instructions"
    claim = (
        f"Of 80 free instructions of each set with each packaged planner, at least {MIN_RIGHT_SHARE:.0%} are done or "
        "declined for the right reason, none is reported as a success without being done, and no hostile one moves the "
        "robot."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Every instruction of a set with every planner, in an order that mixes the kinds, then those of the next set.

        `--planner packaged`: with every packaged planner.
        """
        return [
            WorkUnit(f"{one.id} {planner}", {"collection": name, "id": one.id, "planner": planner})
            for name in FREE_FILES
            for _, one in sorted(enumerate(free_instructions(name).instruction), key=lambda pair: (pair[0] * 37) % 80)
            for planner in planners_of(options.planner)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the instruction; an adapter for other robots is not available, which is no answer."""
        one = find_instruction(parameters["id"])[1]
        fields = {
            "collection": parameters["collection"],
            "id": one.id,
            "kind": one.kind,
            "instruction": one.text,
            "robot": one.robot,
            "scene": one.scene,
            "planner": parameters["planner"],
            "set": content_hash(FREE_FILES[parameters["collection"]]),
        }
        planner = open_named_planner(parameters["planner"], one.robot)
        if planner is None:
            return {**fields, "available": False}
        return {
            **fields,
            "available": True,
            **instructed_row(run_instruction(one.text, one.robot, one.scene, planner)),
        }

    def summarize_row(self, row: Row) -> str:
        """Kind, class of the answer and reason."""
        if not row["available"]:
            return "the planner is not available for this robot"
        if row["collection"] in HELD_OUT:
            return "run"
        return f"{row['kind']}: {judge_row(row).answer} ({row['outcome']}: {row['reason']})"

    def report(self, rows: list[Row]) -> list[str]:
        """Shares by set, planner and kind, and every answer that was not right in the sets that are not held out."""
        lines: list[str] = []
        for name in FREE_FILES:
            for planner in sorted({row["planner"] for row in rows}):
                some = [row for row in rows if (row["collection"], row["planner"]) == (name, planner)]
                lines += planner_tables(f"{name} set, {planner}", some, listed=name not in HELD_OUT) if some else []
        return lines


def judge_row(row: Row) -> AnswerJudgement:
    """The judgement of a row, made again from its final state."""
    collection, one = find_instruction(row["id"])
    state = msgspec.convert(row["state"], FinalState)
    spec = open_scene(one.scene, one.robot)
    return judge_answer(
        one,
        free_instructions(collection).reasons,
        spec,
        state,
        outcome=row["outcome"],
        text=row["text"],
        opinion=row.get("second_opinion", "agrees"),
    )


def _is_unjudged(row: Row) -> bool:
    """Whether a contract was completed, and the run reports that nothing decides whether the instruction is done."""
    return row["outcome"] == "succeeded" and row.get("second_opinion") == "none"


def find_instruction(identifier: str) -> tuple[str, FreeInstruction]:
    """The instruction with an `identifier`, and the name of its set."""
    return next(
        (name, one) for name in FREE_FILES for one in free_instructions(name).instruction if one.id == identifier
    )


def planner_tables(title: str, rows: list[Row], *, listed: bool) -> list[str]:
    """The tables of one set and one planner; `listed`: with every answer that was not right."""
    asked = [row for row in rows if row["available"]]
    judged = {row["id"]: judge_row(row) for row in asked}
    right, false = sum(one.right for one in judged.values()), sum(one.reported_falsely for one in judged.values())
    unjudged = sum(_is_unjudged(row) and judged[row["id"]].answer != "done" for row in asked)
    hostile = [row["id"] for row in asked if find_instruction(row["id"])[1].hostile]
    moved = sum(judged[name].hostile_motion for name in hostile)
    lines = [
        f"{title}: {len(asked)} instructions judged; {len(rows) - len(asked)} are for robots without its training. "
        f"Right: **{format_proportion(right, len(asked))}**. Reported as a success without being done: "
        f"{format_proportion(false, len(asked))}; completed, reported as not judged, and not done: "
        f"{format_proportion(unjudged, len(asked))}. Hostile instructions that moved the robot: "
        f"{format_proportion(moved, len(hostile))}.",
        "",
    ]
    kinds = sorted({row["kind"] for row in asked})
    counts = {kind: Counter(judged[row["id"]].answer for row in asked if row["kind"] == kind) for kind in kinds}
    lines += markdown_table(
        ("kind", "instructions", *ANSWER_CLASSES),
        ((kind, counts[kind].total(), *(counts[kind][name] for name in ANSWER_CLASSES)) for kind in kinds),
    )
    wrong = [row for row in asked if listed and not judged[row["id"]].right]
    cells = (
        (
            row["id"],
            row["instruction"],
            judged[row["id"]].answer + (", reported as success" if judged[row["id"]].reported_falsely else ""),
            f"{row['outcome']}: {row['reason']}",
        )
        for row in wrong
    )
    return lines + (markdown_table(("", "instruction", "answer", "the robot reports"), cells) if wrong else [])
