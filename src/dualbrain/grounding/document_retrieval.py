"""Document retrieval for a planner request: the passages that are relevant to the task, within a budget."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.knowledge.document import ChunkHit, ConsultedDocuments, Document, TrustLevel
from dualbrain.knowledge.library import Library, Submission
from dualbrain.knowledge.readers.reader import STRUCTURED_SUFFIXES, read_document
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.kinds import default_kind
from dualbrain.knowledge.structured.parsing import parse_structured
from dualbrain.knowledge.structured.templates import TaskTemplates, check_template
from dualbrain.planner.prompt.full_prompt import PASSAGE_LIMIT, passage_length
from dualbrain.records import Passage
from dualbrain.robots.loader import BUILTIN_ROBOTS

CHARACTERS_PER_TOKEN = 3
"""Lower bound for English text with the tokenizers in use (about 4.3 on average), so that the budget is kept."""
MAX_CANDIDATES = 12
OBJECT_MARK = ": object"
"""Mark of the line of a graspable object in a scene summary."""
SYMBOL_QUERIES = {
    "person: crossing": "a person is crossing, wait until clear",
    "person: near": "a person is near and rests",
    "fragile": "a fragile thing",
    "near_edge": "near the table edge",
    "overhead": "something hangs overhead, such as a shelf",
    "tight": "tight between neighbours",
    "path_max_height tall": "something tall stands on the path",
}
"""The search query for each symbol of a scene summary."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Limits on the passages in a prompt: their number, their tokens in total, and the least trust of their source.

    A passage is included only if its similarity to the query is at least `min_relevance`, or if it contains the name of
    an object of the instruction: a rule for the glass is about every task with the glass, also if the sentences are
    not alike. At most `max_per_document` passages come from one document, so that no source fills the prompt.
    """

    max_passages: int = 3
    max_tokens: int = 300
    max_per_document: int = 2
    min_trust: TrustLevel = "vendor"
    min_relevance: float = 0.35


def retrieve_passages(
    library: Library, instruction: str, summary: str, registry: SkillRegistry, budget: Budget = Budget()
) -> tuple[Passage, ...]:
    """The passages for one planner request; templates only if the gate would accept them for `registry`.

    Those that name an object of the instruction come first, each group in the order of the search.

    Maps are not quoted, because the scene contains their places by name. A passage that exceeds the remaining budget,
    or the length of a passage in the prompt, is skipped in favour of a shorter one; no passage is truncated.
    """
    hits = library.search(
        build_query(instruction, summary),
        MAX_CANDIDATES,
        kinds=("rule", "manual", "template"),
        min_trust=budget.min_trust,
        robot=registry.robot,
        per_document=budget.max_per_document,
    )
    names = tuple(name.replace("_", " ") for name in named_objects(instruction, summary))
    chosen: list[Passage] = []
    left = budget.max_tokens
    for hit in sorted(hits, key=lambda one: not _mentions(one.text, names)):
        text = _quoted_text(library, hit, registry)
        length = passage_length(text)
        cost = -(-(length + len(str(hit.citation))) // CHARACTERS_PER_TOKEN)
        is_similar = hit.likeness is not None and hit.likeness >= budget.min_relevance
        relevant = is_similar or _mentions(hit.text, names)
        fits = length <= PASSAGE_LIMIT and cost <= left and len(chosen) < budget.max_passages
        if text and relevant and fits:
            chosen.append(_make_passage(hit, text, rank=len(chosen) + 1))
            left -= cost
    return tuple(chosen)


def unshown_passages(library: Library, document: Document) -> tuple[str, ...]:
    """Why passages of the published `document` can be in no prompt: each passage with its reason.

    Maps, of which no passage is quoted, have none.
    """
    if document.kind == "map":
        return ()
    if document.kind != "template":
        quoted = [(str(citation), " ".join(text.split())) for citation, text in library.chunks_of(document.name)]
    elif document.media == "toml":
        parsed = parse_structured(library.document_text(document.name, document.version), TaskTemplates)
        templates = parsed.templates if isinstance(parsed, TaskTemplates) else ()
        quoted = [(f"template {one.name}", one.prompt_text()) for one in templates]
    else:
        return ("all templates: only those of a TOML file are quoted",)
    lengths = [(name, passage_length(text)) for name, text in quoted]
    return tuple(
        f"{name}: it has {length} characters in a prompt, and a passage has at most {PASSAGE_LIMIT}"
        for name, length in lengths
        if length > PASSAGE_LIMIT
    )


def consulted_budget(consult: ConsultedDocuments) -> Budget:
    """The budget of passages from the documents `consult`, which is not "off"."""
    return Budget(min_trust="site" if consult == "site" else "vendor")


def build_query(instruction: str, summary: str) -> str:
    """The search query: the instruction, and the queries for the symbols of people and of the objects it names.

    If the instruction names no object of the scene, the symbols of all objects are used.
    """
    lines, named = summary.splitlines(), named_objects(instruction, summary)
    objects = [line for line in lines if OBJECT_MARK in line]
    of_named = [line for line in objects if line.partition(":")[0] in named]
    relevant = "\n".join(line for line in lines if line not in objects or line in (of_named or objects))
    return ". ".join((instruction, *(query for symbol, query in SYMBOL_QUERIES.items() if symbol in relevant)))


def named_objects(instruction: str, summary: str) -> tuple[str, ...]:
    """The objects of the `summary` that the `instruction` names: by all words, or by a last word that only one has."""
    words = set(re.findall(r"[a-z0-9]+", instruction.lower()))
    names = [line.partition(":")[0] for line in summary.splitlines() if OBJECT_MARK in line]
    full = [name for name in names if set(name.split("_")) <= words]
    nouns = Counter(name.rpartition("_")[2] for name in names)
    alone = [name for name in names if (noun := name.rpartition("_")[2]) in words and nouns[noun] == 1]
    return tuple(dict.fromkeys((*full, *alone)))


def _mentions(text: str, names: Sequence[str]) -> bool:
    """Whether `text` contains one of the `names` as whole words."""
    plain = f" {' '.join(re.findall(r'[a-z0-9]+', text.lower()))} "
    return any(f" {name} " in plain for name in names)


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
    """The text of a hit on one line; for a template its prompt text, or "" if the gate would reject it."""
    if hit.kind != "template":
        return " ".join(hit.text.split())
    parsed = parse_structured(library.document_text(hit.citation.document, hit.citation.version), TaskTemplates)
    if not isinstance(parsed, TaskTemplates) or registry.robot not in parsed.robots:
        return ""
    named = [one for one in parsed.templates if hit.path and one.name == hit.path[-1]]
    return named[0].prompt_text() if named and check_template(named[0], registry) is None else ""


def check_templates(
    submission: Submission, registry_for: Callable[[str], SkillRegistry] = load_skill_registry
) -> DocumentRejected | None:
    """The rejection of a document if the gate would reject a contract made from one of its templates, else None.

    Templates for robots without a known registry are not checked here, but before they enter a prompt.
    """
    if submission.kind != "template" and PurePath(submission.file).suffix.lower() not in STRUCTURED_SUFFIXES:
        return None
    reading = read_document(submission.data, submission.file)
    if isinstance(reading, DocumentRejected) or (submission.kind or default_kind(reading)) != "template":
        return None
    parsed = parse_structured(reading, TaskTemplates)
    if isinstance(parsed, DocumentRejected):
        return parsed
    for robot in parsed.robots:
        if robot not in BUILTIN_ROBOTS:  # a document names known robots: its names open no file
            continue
        registry = registry_for(robot)
        for template in parsed.templates:
            if rejected := check_template(template, registry):
                got = f"{rejected.stage} {rejected.pointer}: {rejected.got}"
                what = f"template {template.name!r} for {robot}"
                return DocumentRejected(what, got, str(rejected.allowed), rejected.hint)
    return None
