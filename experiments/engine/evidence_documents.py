"""Documents that the evidence package copies: SAFETY.md, and the figures of the experiments of the requirements."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.evaluation.evidence.copied_documents import FIGURES_FILE, SAFETY_FILE, ExperimentFigures
from dualbrain.evaluation.evidence.requirement import read_requirements

DATA_FOLDER = Path("src/dualbrain/evaluation/evidence/data")
"""Folder of the packaged copies, relative to the root of the repository."""
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_IMAGE_LINE = re.compile(r"^!\[.*\]\(.*\)$\n?", re.MULTILINE)
_CLAIM = re.compile(r"^\*\*Claim\.\*\* (.*)$", re.MULTILINE)
_FACT = re.compile(r"^\| (date|units|revision|machine|intervals) \| (.*) \|$", re.MULTILINE)


def collect_figures(docs: Path) -> dict[str, ExperimentFigures]:
    """The figures of the experiments that a requirement names; raises `ValueError` if one has no page."""
    names = sorted({name for one in read_requirements().values() for name in one.experiments})
    pages = {page.stem: page for page in (docs / "experiments").glob("*/*.md")}
    if missing := [name for name in names if name not in pages]:
        raise ValueError(f"experiments without a page: {', '.join(missing)}")
    return {name: parse_page(pages[name].read_text("utf-8")) for name in names}


def collect_copies(root: Path) -> dict[str, bytes]:
    """The packaged copies by file name, from the repository at `root`."""
    figures = msgspec.json.format(msgspec.json.encode(collect_figures(root / "docs")), indent=1) + b"\n"
    safety = without_links((root / "SAFETY.md").read_text("utf-8")).encode()
    return {FIGURES_FILE: figures, SAFETY_FILE: safety}


def write_copies(root: Path) -> None:
    """Write the packaged copies in the repository at `root`."""
    for name, content in collect_copies(root).items():
        write_atomically(root / DATA_FOLDER / name, content, private=False)


def parse_page(text: str) -> ExperimentFigures:
    """The figures on the page of an experiment; raises `ValueError` if it has no claim, date or results."""
    claim = _CLAIM.search(text)
    head, found, results = text.partition("\n## Results\n")
    facts = dict(_FACT.findall(head))
    if claim is None or not found or not {"date", "revision"} <= facts.keys():
        raise ValueError("the page has no claim, no date and revision, or no results")
    return ExperimentFigures(
        title=text.partition("\n")[0].removeprefix("# "),
        claim=without_links(claim[1]),
        facts={name: without_links(value) for name, value in facts.items()},
        results=without_links(_IMAGE_LINE.sub("", results)).strip(),
    )


def without_links(text: str) -> str:
    """`text` with the words of its links alone: their targets are not in the evidence."""
    return _LINK.sub(r"\1", text)
