"""Consulting documents before a planner is asked: the few passages that bear on the task, within a budget."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.errors import UnknownNameError
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.knowledge.document import ChunkHit, TrustLevel
from dualbrain.knowledge.library import Library, Submission
from dualbrain.knowledge.readers.reader import read_document
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.kinds import default_kind
from dualbrain.knowledge.structured.parsing import parse_structured
from dualbrain.knowledge.structured.templates import TaskTemplates, check_template
from dualbrain.records import Passage

CHARACTERS_PER_TOKEN = 3
"""Fewer than any English text has with the tokenizers in use (about 4.3), so that the budget holds."""
MAX_CANDIDATES = 12
SYMBOL_QUERIES = {
    "person: crossing": "a person is crossing, wait until clear",
    "person: near": "a person is near and rests",
    "fragile": "a fragile thing",
    "near_edge": "near the table edge",
    "overhead": "something hangs overhead, such as a shelf",
    "tight": "tight between neighbours",
    "path_max_height tall": "something tall stands on the path",
}
"""What a symbol of the scene asks of the documents, in words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How much may enter the prompt: `passages` of at most `tokens` together, from sources trusted at least `least`.

    A passage enters only if its likeness to the question is at least `relevance`, so that where nothing bears on the
    task nothing is shown; and at most `per_document` of one document, so that no source fills the prompt.
    """

    max_passages: int = 3
    max_tokens: int = 300
    max_per_document: int = 2
    min_trust: TrustLevel = "vendor"
    min_relevance: float = 0.35


def retrieve_passages(
    library: Library, instruction: str, summary: str, registry: SkillRegistry, budget: Budget = Budget()
) -> tuple[Passage, ...]:
    """The passages for one question, best first; templates only if the gate would accept them for `registry`.

    Maps are not quoted: their places stand in the scene by name. A passage that no longer fits is passed over for a
    shorter one; none is cut.
    """
    hits = library.search(
        build_query(instruction, summary),
        MAX_CANDIDATES,
        kinds=("rule", "manual", "template"),
        min_trust=budget.min_trust,
        robot=registry.robot,
        per_document=budget.max_per_document,
    )
    chosen: list[Passage] = []
    left = budget.max_tokens
    for hit in hits:
        text = _quoted_text(library, hit, registry)
        cost = -(-(len(text) + len(str(hit.citation))) // CHARACTERS_PER_TOKEN)
        relevant = hit.likeness is not None and hit.likeness >= budget.min_relevance
        if text and relevant and cost <= left and len(chosen) < budget.max_passages:
            chosen.append(_make_passage(hit, text, rank=len(chosen) + 1))
            left -= cost
    return tuple(chosen)


def build_query(instruction: str, summary: str) -> str:
    """What is asked of the documents: the instruction, and what the symbols of people and of the things it names mean.

    Where it names nothing of the scene, the symbols of everything.
    """
    lines, words = summary.splitlines(), set(re.findall(r"[a-z0-9]+", instruction.lower()))
    things = [line for line in lines if ": object" in line]
    named = [line for line in things if set(line.partition(":")[0].split("_")) <= words]
    bearing = "\n".join(line for line in lines if line not in things or line in (named or things))
    return ". ".join((instruction, *(meaning for symbol, meaning in SYMBOL_QUERIES.items() if symbol in bearing)))


def _make_passage(hit: ChunkHit, text: str, rank: int) -> Passage:
    title = " › ".join(dict.fromkeys((hit.title, *hit.path)))
    likeness = hit.likeness or 0.0
    return Passage(
        citation=str(hit.citation),
        kind=hit.kind,
        trust=hit.trust,
        title=title,
        text=text,
        likeness=likeness,
        score=hit.score,
        rank=rank,
    )


def _quoted_text(library: Library, hit: ChunkHit, registry: SkillRegistry) -> str:
    """The quotation on one line; of a template its skeleton, or nothing where the gate would refuse it."""
    if hit.kind != "template":
        return " ".join(hit.text.split())
    whole = parse_structured(library.document_text(hit.citation.document, hit.citation.version), TaskTemplates)
    if not isinstance(whole, TaskTemplates) or registry.robot not in whole.robots:
        return ""
    named = [one for one in whole.templates if hit.path and one.name == hit.path[-1]]
    return named[0].prompt_text() if named and check_template(named[0], registry) is None else ""


def check_templates(
    submission: Submission, registry_for: Callable[[str], SkillRegistry] = load_skill_registry
) -> DocumentRejected | None:
    """Why a document of templates is refused before it is added: the gate would refuse a contract made from one.

    Robots that are not known here cannot be judged now; their templates are judged when they are to be shown.
    """
    reading = read_document(submission.data, submission.file)
    if isinstance(reading, DocumentRejected) or (submission.kind or default_kind(reading)) != "template":
        return None
    whole = parse_structured(reading, TaskTemplates)
    if isinstance(whole, DocumentRejected):
        return whole
    for robot in whole.robots:
        try:
            registry = registry_for(robot)
        except UnknownNameError:
            continue
        for template in whole.templates:
            if why := check_template(template, registry):
                got = f"{why.stage} {why.pointer}: {why.got}"
                return DocumentRejected(f"template {template.name!r} for {robot}", got, str(why.allowed), why.hint)
    return None
