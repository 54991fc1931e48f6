"""Instructions with and without clauses that contracts cannot express: which of them the local check declines.

The check is the one that precedes every planner. No robot moves and no planner answers; only the perceived scene is
needed.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from dualbrain.grounding.instruction.review import Refusal, review_instruction
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.evaluation.instructions.instruction_set import clause_instructions, content_hash
from experiments.figures.tables import format_proportion, markdown_table

MAX_DECLINED_PLAIN = 2
INSTRUCTION_FILE = "clauses.toml"


class Clauses:
    """No clause is dropped silently, and no other instruction is declined because of the check."""

    name = "clauses"
    claim = (
        "Of 60 instructions with a clause that contracts cannot express, the local check declines every one and names "
        f"the clause; of 60 instructions without such a clause it declines at most {MAX_DECLINED_PLAIN}."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit for each instruction."""
        del options
        sets = clause_instructions()
        return [
            WorkUnit(f"clause {index:02d}", {"set": "clause", "index": index}) for index in range(len(sets.clause))
        ] + [WorkUnit(f"plain {index:02d}", {"set": "plain", "index": index}) for index in range(len(sets.plain))]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Check one instruction in its scene."""
        one = getattr(clause_instructions(), parameters["set"])[parameters["index"]]
        fields = {"kind": one.kind, "instruction": one.text, "file": content_hash(INSTRUCTION_FILE)}
        return {**parameters, **fields, "refusal": refusal_of(one.text, perceive(one.scene, one.robot), one.robot)}

    def summarize_row(self, row: Row) -> str:
        """Whether the instruction was declined."""
        return f"{row['kind']}: {row['refusal'] or 'passed on'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Declined instructions by kind, and every wrong one."""
        clause, plain = ([row for row in rows if row["set"] == name] for name in ("clause", "plain"))
        named, declined = [row for row in clause if is_right(row)], [row for row in plain if row["refusal"]]
        passed = [row for row in clause if not row["refusal"]]
        lines = [
            f"With a clause: declined and named {format_proportion(len(named), len(clause))}; passed on "
            f"{format_proportion(len(passed), len(clause))}. Without: declined "
            f"{format_proportion(len(declined), len(plain))}.",
            "",
        ]
        total, right = Counter(row["kind"] for row in clause), Counter(row["kind"] for row in named)
        head = ("kind of clause", "instructions", "declined and named")
        lines += markdown_table(head, ((kind, total[kind], right[kind]) for kind in sorted(total)))
        wrong = [row for row in rows if not is_right(row)]
        cells = ((row["key"], row["instruction"], row["refusal"] or "passed on") for row in wrong)
        return lines + (markdown_table(("", "instruction", "answer of the check"), cells) if wrong else [])


def refusal_of(text: str, scene: Scene, robot: str) -> str | None:
    """The reason for which the instruction `text` is declined; None if a planner may be asked."""
    review = review_instruction(text, skill_registry(load_robot(robot)), scene.receptive, scene.graspable)
    return review.reason if isinstance(review, Refusal) else None


def is_right(row: Row) -> bool:
    """A clause is declined and named, and an instruction without a clause is not declined."""
    if row["set"] == "plain":
        return row["refusal"] is None
    names = clause_instructions().clause[row["index"]].names
    return row["refusal"] is not None and any(name in row["refusal"].lower() for name in names)


def perceive(scene: str, robot: str) -> Scene:
    """The initial scene, perceived without noise."""
    spec = open_scene(scene, robot)
    plant = make_plant(spec, load_robot(robot))
    return NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)
