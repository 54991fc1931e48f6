"""Consulting documents before a planner is asked: the few passages that bear on the task, within a budget."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from dualbrain.contracts.registry import Registry
from dualbrain.errors import UnknownName
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.knowledge.document import Hit, Trust
from dualbrain.knowledge.library import Library, Submission
from dualbrain.knowledge.readers.reader import read
from dualbrain.knowledge.rejection import Refused
from dualbrain.knowledge.structured.kinds import default_kind
from dualbrain.knowledge.structured.parsing import structure
from dualbrain.knowledge.structured.templates import TaskTemplates, judge
from dualbrain.records import Passage

CHARACTERS_PER_TOKEN = 3
"""Fewer than any English text has with the tokenizers in use (about 4.3), so that the budget holds."""
CANDIDATES = 12
SYMBOLS = {
    "person: crossing": "a person is crossing, wait until clear",
    "person: near": "a person is near and rests",
    "fragile": "a fragile thing",
    "near_edge": "near the table edge",
    "overhead": "something hangs overhead, such as a shelf",
    "tight": "tight between neighbours",
    "path_max_height tall": "something tall stands on the path",
}
"""What a symbol of the scene asks of the documents, in words."""


@dataclass(frozen=True, slots=True)
class Budget:
    """How much may enter the prompt: `passages` of at most `tokens` together, from sources trusted at least `least`.

    A passage enters only if its likeness to the question is at least `relevance`, so that where nothing bears on the
    task nothing is shown; and at most `per_document` of one document, so that no source fills the prompt.
    """

    passages: int = 3
    tokens: int = 300
    per_document: int = 2
    least: Trust = "vendor"
    relevance: float = 0.35


def consult(
    library: Library, instruction: str, summary: str, registry: Registry, budget: Budget = Budget()
) -> tuple[Passage, ...]:
    """The passages for one question, best first; templates only if the gate would accept them for `registry`.

    Maps are not quoted: their places stand in the scene by name. A passage that no longer fits is passed over for a
    shorter one; none is cut.
    """
    hits = library.search(
        question(instruction, summary), CANDIDATES, kinds=("rule", "manual", "template"), least=budget.least,
        body=registry.robot, per_document=budget.per_document,
    )  # fmt: skip
    chosen: list[Passage] = []
    left = budget.tokens
    for hit in hits:
        text = _shown(library, hit, registry)
        cost = -(-(len(text) + len(str(hit.citation))) // CHARACTERS_PER_TOKEN)
        relevant = hit.likeness is not None and hit.likeness >= budget.relevance
        if text and relevant and cost <= left and len(chosen) < budget.passages:
            chosen.append(_passage(hit, text, rank=len(chosen) + 1))
            left -= cost
    return tuple(chosen)


def question(instruction: str, summary: str) -> str:
    """What is asked of the documents: the instruction, and what the symbols of people and of the things it names mean.

    Where it names nothing of the scene, the symbols of everything.
    """
    lines, words = summary.splitlines(), set(re.findall(r"[a-z0-9]+", instruction.lower()))
    things = [line for line in lines if ": object" in line]
    named = [line for line in things if set(line.partition(":")[0].split("_")) <= words]
    bearing = "\n".join(line for line in lines if line not in things or line in (named or things))
    return ". ".join((instruction, *(meaning for symbol, meaning in SYMBOLS.items() if symbol in bearing)))


def _passage(hit: Hit, text: str, rank: int) -> Passage:
    title = " › ".join(dict.fromkeys((hit.title, *hit.path)))
    likeness = hit.likeness or 0.0
    return Passage(str(hit.citation), hit.kind, hit.trust, title, text, likeness, hit.score, rank)


def _shown(library: Library, hit: Hit, registry: Registry) -> str:
    """The quotation on one line; of a template its skeleton, or nothing where the gate would refuse it."""
    if hit.kind != "template":
        return " ".join(hit.text.split())
    whole = structure(library.reading(hit.citation.document, hit.citation.version), TaskTemplates)
    if not isinstance(whole, TaskTemplates) or registry.robot not in whole.robots:
        return ""
    named = [one for one in whole.templates if hit.path and one.name == hit.path[-1]]
    return named[0].words() if named and judge(named[0], registry) is None else ""


def unfit_templates(submission: Submission, robots: Callable[[str], Registry] = vocabulary) -> Refused | None:
    """Why a document of templates is refused before it is added: the gate would refuse a contract made from one.

    Robots that are not known here cannot be judged now; their templates are judged when they are to be shown.
    """
    reading = read(submission.data, submission.file)
    if isinstance(reading, Refused) or (submission.kind or default_kind(reading)) != "template":
        return None
    whole = structure(reading, TaskTemplates)
    if isinstance(whole, Refused):
        return whole
    for robot in whole.robots:
        try:
            registry = robots(robot)
        except UnknownName:
            continue
        for template in whole.templates:
            if why := judge(template, registry):
                got = f"{why.stage} {why.pointer}: {why.got}"
                return Refused(f"template {template.name!r} for {robot}", got, str(why.allowed), why.hint)
    return None
