"""Instructions with and without clauses that contracts cannot express: which of them the local check declines.

The check is the one that precedes every planner. No robot moves and no planner answers; only the perceived scene is
needed.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import Any

import numpy as np

from dualbrain.core.paths import cache_folder
from dualbrain.grounding.instruction.clauses.clause_classifier import ClauseClassifier
from dualbrain.grounding.instruction.goals.goal import Goal
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.review import Refusal, review_instruction
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.evaluation.instructions.instruction_set import CLAUSE_FILES, clause_instructions, content_hash
from experiments.figures.tables import format_proportion, markdown_table

MAX_DECLINED_PLAIN = 2
HELD_OUT = frozenset({"third", "fourth", "fifth"})
"""The sets whose errors are counted and never listed, so that the check is not corrected by them."""


class Clauses:
    """No clause is dropped silently, and no other instruction is declined because of the check."""

    name = "clauses"
    claim = (
        "In each of five sets of 60 instructions with a clause that contracts cannot express and 60 without one, the "
        f"local check declines and names every clause, and declines at most {MAX_DECLINED_PLAIN} of the others. No "
        "instruction with a clause that the check passes on is read as one without it, so that none is shortened in "
        "silence: its outcome is reported as not judged."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit for each instruction of each set."""
        del options
        return [
            WorkUnit(f"{name} {part} {k:02d}", {"collection": name, "set": part, "index": k})
            for name in CLAUSE_FILES
            for part in ("clause", "plain")
            for k in range(len(getattr(clause_instructions(name), part)))
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Check one instruction in its scene."""
        collection = parameters["collection"]
        one = getattr(clause_instructions(collection), parameters["set"])[parameters["index"]]
        fields = {"kind": one.kind, "instruction": one.text, "file": content_hash(CLAUSE_FILES[collection])}
        scene = perceive(one.scene, one.robot)
        return {
            **parameters,
            **fields,
            "refusal": refusal_of(one.text, scene, one.robot, packaged_classifier()),
            "by_rules": refusal_of(one.text, scene, one.robot),
            "read": is_read(one.text, scene),
        }

    def summarize_row(self, row: Row) -> str:
        """Whether the instruction was declined."""
        if row["collection"] in HELD_OUT:
            return "checked"
        return f"{row['kind']}: {row['refusal'] or 'passed on'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Declined instructions by set and by kind, and every wrong one of the sets that are not held out."""
        collections = [name for name in CLAUSE_FILES if any(row["collection"] == name for row in rows)]
        head = (
            "set",
            "with a clause: declined and named",
            "with a clause: passed on",
            "passed on, and could be confirmed without it",
            "without one: declined",
            "without one: goal read",
        )
        lines = []
        for title, judged in (("Rules and classifier:", rows), ("Rules alone:", [by_rules(row) for row in rows])):
            sets = [(name, *shares([r for r in judged if r["collection"] == name])) for name in collections]
            lines += [title, "", *markdown_table(head, sets)]
        lines += markdown_table(("kind of clause", *collections), rows_by_kind(rows, collections))
        wrong = [row for row in rows if not is_right(row) and row["collection"] not in HELD_OUT]
        cells = ((row["key"], row["instruction"], row["refusal"] or "passed on") for row in wrong)
        return lines + (markdown_table(("", "instruction", "answer of the check"), cells) if wrong else [])


def by_rules(row: Row) -> Row:
    """The row as the rules alone judge it."""
    return {**row, "refusal": row["by_rules"]}


@cache
def packaged_classifier() -> ClauseClassifier | None:
    """The classifier of `dualbrain run`."""
    return ClauseClassifier.packaged(MiniLmEncoder.from_cache(cache_folder()))


def shares(rows: list[Row]) -> tuple[str, ...]:
    """Of the `rows` of one set: clauses declined and named, passed on, passed on and read; others declined, read."""
    clause, plain = ([row for row in rows if row["set"] == part] for part in ("clause", "plain"))
    counts = (
        (sum(map(is_right, clause)), len(clause)),
        (sum(row["refusal"] is None for row in clause), len(clause)),
        (sum(row["refusal"] is None and row["read"] for row in clause), len(clause)),
        (sum(row["refusal"] is not None for row in plain), len(plain)),
        (sum(row["refusal"] is None and row["read"] for row in plain), len(plain)),
    )
    return tuple(format_proportion(*count) for count in counts)


def rows_by_kind(rows: list[Row], collections: list[str]) -> list[tuple[str, ...]]:
    """For each kind of clause: the declined and named ones of all, in each set."""
    clause = [row for row in rows if row["set"] == "clause"]
    total = Counter((row["kind"], row["collection"]) for row in clause)
    right = Counter((row["kind"], row["collection"]) for row in clause if is_right(row))
    kinds = sorted({row["kind"] for row in clause})
    return [
        (kind, *(f"{right[kind, name]} of {total[kind, name]}" if total[kind, name] else "" for name in collections))
        for kind in kinds
    ]


def refusal_of(text: str, scene: Scene, robot: str, classifier: ClauseClassifier | None = None) -> str | None:
    """The reason for which the instruction `text` is declined; None if a planner may be asked."""
    registry = skill_registry(load_robot(robot))
    review = review_instruction(text, registry, scene.receptive, scene.graspable, classifier=classifier)
    return review.reason if isinstance(review, Refusal) else None


def is_read(text: str, scene: Scene) -> bool:
    """Whether the goal parser accounts for all words and finds a goal that contracts can state.

    Only then can the senses of the robot confirm a success, and the contract is compared with the words.
    """
    goal = read_goal(text, scene)
    return isinstance(goal, Goal) and not (goal.decline or goal.beyond_contracts)


def is_right(row: Row) -> bool:
    """A clause is declined and named, and an instruction without a clause is not declined."""
    if row["set"] == "plain":
        return row["refusal"] is None
    names = clause_instructions(row["collection"]).clause[row["index"]].names
    return row["refusal"] is not None and any(name in row["refusal"].lower() for name in names)


def perceive(scene: str, robot: str) -> Scene:
    """The initial scene, perceived without noise."""
    spec = open_scene(scene, robot)
    plant = make_plant(spec, load_robot(robot))
    return NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)
