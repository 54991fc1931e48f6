"""Every reference of hazards and requirements exists, and the packaged copies equal the documents of the repository."""

import ast
from functools import lru_cache
from pathlib import Path

import pytest

from dualbrain.evaluation.evidence.requirement import read_hazards, read_requirements, required_tests
from experiments.engine.evidence_documents import DATA_FOLDER, collect_copies, parse_page

ROOT = Path(__file__).resolve().parents[3]


@lru_cache
def defined_names(path):
    """Names of functions and classes in a source file, and "Class.method"."""
    found = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{one.name}" for one in node.body if isinstance(one, ast.FunctionDef)}
    return found


def test_every_test_of_a_requirement_exists():
    for test in required_tests():
        file, _, function = test.partition(":")
        assert function in defined_names(ROOT / file), test


def test_every_code_reference_exists():
    for name, one in read_requirements().items():
        for reference in one.code:
            file, _, symbol = reference.partition(":")
            path = ROOT / "src" / "dualbrain" / file
            assert path.exists(), (name, reference)
            assert not symbol or symbol in defined_names(path), (name, reference)


def test_hazards_refer_to_requirements_and_every_requirement_has_tests():
    requirements = read_requirements()
    for hazard in read_hazards().values():
        assert set(hazard.requirements) <= requirements.keys()
        assert hazard.residual
    assert all(one.tests for one in requirements.values())


def test_the_copies_equal_the_documents_of_the_repository():
    remedy = "write them again: python -m experiments NAME --tables --write-docs"
    for name, content in collect_copies(ROOT).items():
        assert (ROOT / DATA_FOLDER / name).read_bytes() == content, f"{name} is old; {remedy}"


def test_a_page_without_results_or_revision_is_refused():
    page = "# A\n\n**Claim.** b\n\n| date | 2026-01-01 |\n| revision | abc |\n\n## Results\n\n[c](d.md)\n![e](f.png)\n"
    figures = parse_page(page)
    assert (figures.title, figures.claim, figures.results) == ("A", "b", "c")
    for missing in ("**Claim.** b", "| revision | abc |\n", "## Results"):
        with pytest.raises(ValueError, match="the page has no"):
            parse_page(page.replace(missing, ""))
