"""Documents of the repository in the evidence: SAFETY.md, and experiments with their date and revision.

They are not part of the installed package, so `python -m experiments --write-docs` copies them into data/; a test
compares the copies with the documents.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import resources

import msgspec

FIGURES_FILE, SAFETY_FILE = "figures.json", "safety.md"


class ExperimentFigures(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The results of an experiment as Markdown, its claim, and the facts about its run."""

    title: str
    claim: str
    facts: dict[str, str]
    results: str


@lru_cache
def read_figures() -> dict[str, ExperimentFigures]:
    """The packaged figures by the name of the experiment."""
    return msgspec.json.decode(_read(FIGURES_FILE), type=dict[str, ExperimentFigures])


@lru_cache
def read_safety_page() -> str:
    """SAFETY.md of this version, without the targets of its links."""
    return _read(SAFETY_FILE).decode()


def _read(name: str) -> bytes:
    return (resources.files("dualbrain.evaluation.evidence") / "data" / name).read_bytes()
