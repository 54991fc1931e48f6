"""Random instructions for a scene: the sentence, and the skeleton of the contract that answers it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualbrain.adaptation.synthetic.templates import POSSIBLE, Phrasings, TaskTemplate, TemplateBook
from dualbrain.contracts.contract import ParameterValue
from dualbrain.contracts.scene_names import SceneNames

SkillSteps = tuple[tuple[str, dict[str, ParameterValue]], ...]
"""Skills in order, each with the parameters that the sentence decides."""
SHORT_NAME_PROBABILITY = 0.25
"""Probability that an object that is the only one of its category is named without its colour."""
MAX_GROUP_SIZE = 3
"""Maximum number of objects in a group."""


@dataclass(frozen=True)
class InstructionSample:
    """A sentence of one `kind` of task and the steps that answer it.

    `is_possible` is False if the answer is a decline.
    """

    kind: str
    sentence: str
    steps: SkillSteps
    is_possible: bool


def draw_instruction(
    names: SceneNames, mobile: bool, book: TemplateBook, phrasings: Phrasings, rng: np.random.Generator
) -> InstructionSample | None:
    """An instruction for a scene with these `names`; None if the drawn task needs objects that are not there."""
    kinds = [name for name in book.kinds if name in phrasings.sentences]
    shares = np.array([book.kinds[name].share for name in kinds])
    name = kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))]
    kind, label = book.kinds[name], phrasings.labels.get(name, POSSIBLE)
    sentence = str(rng.choice(np.array(phrasings.sentences[name], object)))
    values, group, words = _draw_slots(names, mobile, kind, phrasings, rng)
    if any(f"{{{slot}}}" in sentence and not word for slot, word in words.items()):
        return None
    if rng.random() < book.impossible.get(name, 0.0):
        slot, absent_name = _draw_absent(names, mobile, book, sentence, rng)
        refusal: dict[str, ParameterValue] = {"reason": book.reasons["absent"].format(what=absent_name)}
        return InstructionSample(
            name, vary_punctuation(sentence.format(**words | {slot: absent_name}), rng), (("decline", refusal),), False
        )
    if kind.clause:
        return _draw_clause(name, sentence.format(**words), book, rng)
    sentence = vary_punctuation(sentence.format(**words), rng)
    if label != POSSIBLE:
        return InstructionSample(name, sentence, (("decline", {"reason": book.reasons[label]}),), False)
    objects: list[ParameterValue] = list(group) if kind.each else [values["object"]]
    steps = tuple(
        (
            step["skill"],
            {key: (values | {"object": name_of_object})[slot] for key, slot in step.items() if key != "skill"},
        )
        for name_of_object in objects
        for step in kind.contract
    )
    return InstructionSample(name, sentence, steps, True)


def _draw_clause(kind: str, marked: str, book: TemplateBook, rng: np.random.Generator) -> InstructionSample:
    """An instruction with a clause, and the decline that quotes its words as they are in the sentence."""
    before, clause_kind, words, after = split_clause(marked)
    varied = vary_punctuation(before + words + after, rng)
    quote = varied[len(before) : len(before) + len(words)]
    reason = book.reasons["clause"].format(what=quote, kind=clause_kind)
    return InstructionSample(kind, varied, (("decline", {"reason": reason}),), False)


def split_clause(marked: str) -> tuple[str, str, str, str]:
    """The text before the clause of a sentence with [[KIND: words]], the kind, the words, and the text after it."""
    before, _, rest = marked.partition("[[")
    clause, _, after = rest.partition("]]")
    kind, _, words = clause.partition(": ")
    return before, kind, words, after


def vary_punctuation(sentence: str, rng: np.random.Generator) -> str:
    """`sentence` with or without a capital letter and a full stop, as people type."""
    draw = float(rng.random())
    if draw < 0.4 or not sentence:
        return sentence
    sentence = sentence[0].upper() + sentence[1:]
    return sentence if draw < 0.7 or sentence[-1] in ".?!" else f"{sentence}."


def _draw_slots(
    names: SceneNames, mobile: bool, kind: TaskTemplate, phrasings: Phrasings, rng: np.random.Generator
) -> tuple[dict[str, ParameterValue], list[str], dict[str, str]]:
    """The value of each slot, the objects of a group, and the words for each slot; "" if the scene has no value for it.

    For an arm the first receptive name is a container and the others are places on the table; for a mobile base all are
    alike.
    """
    objects, places = _shuffled(names.graspable, rng), _shuffled(names.receptive, rng)
    containers, spots = (_shuffled(some, rng) for some in (names.receptive[:1], names.receptive[1:]))
    target = next(iter({"container": containers, "place": spots, "any": places}[kind.target]), "")
    second_target = next((one for one in (places if mobile or not spots else spots) if one != target), "")
    named = {
        "object": objects[0] if objects else "",
        "second": objects[1] if len(objects) > 1 else "",
        "target": target,
        "second_target": second_target,
    }
    words = {slot: _draw_name(name, names, phrasings, rng) if name else "" for slot, name in named.items()}
    group, plural = _draw_group(names, rng)
    heading = any("heading" in step for step in kind.contract)
    number = round(float(rng.integers(-31, 32)) / 10, 1) if heading else float(rng.integers(1, 11))
    return {**named, "number": number}, group, {**words, "group": plural, "number": f"{number:g}"}


def _draw_name(name: str, names: SceneNames, phrasings: Phrasings, rng: np.random.Generator) -> str:
    """Words for `name`: its natural name, or its category alone if that is unambiguous."""
    kind = name.rpartition("_")[2]
    alone = sum(one.endswith(f"_{kind}") for one in names.all_names) == 1 and phrasings.natural_name(
        name
    ) == name.replace("_", " ")
    return kind if alone and rng.random() < SHORT_NAME_PROBABILITY else phrasings.natural_name(name)


def _draw_group(names: SceneNames, rng: np.random.Generator) -> tuple[list[str], str]:
    """Two or three objects of one colour or category, in the order of the scene, and their name in the plural."""
    groups: dict[str, list[str]] = {}
    for name in names.graspable:
        colour, _, kind = name.partition("_")
        groups.setdefault(f"{colour} things", []).append(name)
        groups.setdefault(f"{kind}s" if not kind.endswith("x") else f"{kind}es", []).append(name)
    plurals = [plural for plural, found in groups.items() if 1 < len(found) <= MAX_GROUP_SIZE]
    if not plurals:
        return [], ""
    plural = plurals[int(rng.integers(len(plurals)))]
    return groups[plural], plural


def _draw_absent(
    names: SceneNames, mobile: bool, book: TemplateBook, sentence: str, rng: np.random.Generator
) -> tuple[str, str]:
    """A slot of the sentence, and words for an object or place that does not exist in the scene."""
    absent, colour = book.absent, str(rng.choice(book.absent.colours))
    if mobile:
        return "target", str(rng.choice(absent.rooms))
    if "{target}" in sentence and rng.random() < 0.4:
        return "target", str(rng.choice(absent.places))
    lacking = [f"{colour} {one}" for one in absent.things if f"{colour}_{one}" not in names.graspable]
    return "object", str(rng.choice(lacking))


def _shuffled(names: tuple[str, ...], rng: np.random.Generator) -> list[str]:
    return [names[int(i)] for i in rng.permutation(len(names))]
