"""The sentences with which the classifier of clauses is trained."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dualbrain.adaptation.synthetic.templates import load_templates
from dualbrain.simulation.tasks.instructions import instruction_templates, task_kinds

WRITTEN = Path(__file__).with_name("sentences.jsonl")
"""Sentences that a language model wrote in 15 manners of speech; it had seen neither the rules nor a parser."""
DEVELOPMENT = Path("tests/grounding/instruction/sentences.toml")
"""Sentences on whose errors the rules were developed."""
SETS = tuple(Path("experiments/evaluation/instructions/clauses", name) for name in ("first.toml", "second.toml"))
"""The sets whose errors were read; the third, fourth and fifth are held out."""

FILLS = (
    {"object": "red cube", "target": "blue bowl", "second": "green tin", "group": "red things", "number": "5"},
    {"object": "white tin", "target": "shelf", "second": "brown box", "group": "tins", "number": "12"},
)
"""Words for the slots of the packaged sentences."""


@dataclass(frozen=True, slots=True)
class Sentence:
    """An instruction: `clause` states whether it has one; `kind` and `words` describe it where they are known."""

    text: str
    clause: bool
    kind: str = ""
    words: str = ""


def training_sentences() -> list[Sentence]:
    """All sentences, each text once."""
    found = {one.text: one for one in (*_written(), *_development(), *_sets(), *_packaged())}
    return list(found.values())


def _written() -> Iterator[Sentence]:
    for line in WRITTEN.read_text().splitlines():
        one = json.loads(line)
        yield Sentence(one["text"], "kind" in one, one.get("kind", ""), one.get("words", ""))


def _development() -> Iterator[Sentence]:
    content = tomllib.loads(DEVELOPMENT.read_text())
    groups: list[dict[str, Any]] = [content, *content["scenes"].values()]
    for group in groups:
        for part in ("clauses", "plain"):
            yield from (Sentence(text, part == "clauses") for text in group.get(part, ()))


def _sets() -> Iterator[Sentence]:
    for path in SETS:
        content = tomllib.loads(path.read_text())
        for part in ("clause", "plain"):
            yield from (Sentence(one["text"], part == "clause") for one in content[part])


def _packaged() -> Iterator[Sentence]:
    """Every packaged sentence that a robot can carry out, twice."""
    templates = [one.text for name in task_kinds(label="possible") for one in instruction_templates(name)]
    for kind in load_templates().kinds.values():
        templates += [*kind.train_sentences, *kind.held_out] if kind.contract else []
    for template in templates:
        for fill, place in zip(FILLS, ("left side of the table", "charger"), strict=True):
            yield Sentence(template.format(**fill, second_target=place), clause=False)
