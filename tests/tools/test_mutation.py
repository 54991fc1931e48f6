"""Mutation test: mutants are small reproducible changes; verdicts name the detecting test."""

import ast
import itertools
import signal
from collections import Counter
from pathlib import Path

import pytest

from tools.mutation.mutation_sites import KINDS
from tools.mutation.sampling import find_sites, make_mutant, sample_mutants, source_files
from tools.mutation.sandbox import classify_run, evaluated_code
from tools.mutation.tokens import tokenize

ROOT = Path(__file__).resolve().parents[2]
C = """/* a + b */
#include "x.h"
static dbk_real f(const dbk_model *model, const dbk_real *v, int32_t n) {
  dbk_real sum = (dbk_real)0;
  for (int32_t k = 0; k < n; ++k) { sum += model->period * v[k]; } // v[3] < 2
  if (!(sum >= (dbk_real)-1)) { return dbk_min(sum, v[0] - v[1]); }
  return sum;
}
"""
PYTHON = '''"""Words - no code [0]."""
def f(body, lower):
    """a < b + 1"""
    return {"x < y": 2.0 * body.alpha + lower[0]} if body.n > 3 else min(lower)
'''


def afters(source, suffix, kind):
    return {
        make_mutant("f", source, kind, s, choice).after
        for s in find_sites(source, suffix).get(kind, [])
        for choice in s[2]
    }


def test_comments_strings_and_includes_are_not_changed():
    assert "a" not in [token.text for token in tokenize(C, ".c")]
    assert "h" not in [token.text for token in tokenize(C, ".c")]
    assert {"Words", "y"}.isdisjoint(token.text for token in tokenize(PYTHON, ".py"))
    for kind in KINDS:
        assert all("a + b" in after for after in afters(C, ".c", kind) if after.startswith("/*"))


def test_every_kind_yields_its_fault():
    loop = "for (int32_t k = 0; k < n; ++k) { sum += model->period * v[k]; } // v[3] < 2"
    assert loop.replace("+=", "-=") in afters(C, ".c", "sign")
    assert loop.replace("v[k]", "v[k + 1]") in afters(C, ".c", "index")
    assert loop.replace("model->period", "((dbk_real)57.3 * model->period)") in afters(C, ".c", "unit")
    assert loop.replace("k < n", "k <= n") in afters(C, ".c", "comparison")
    assert loop.replace("k = 0", "k = 1") in afters(C, ".c", "constant")
    assert loop.replace(" * v[k]", "") in afters(C, ".c", "dropped")
    check = "if (!(sum >= (dbk_real)-1)) { return dbk_min(sum, v[0] - v[1]); }"
    assert check.replace("dbk_min", "dbk_max") in afters(C, ".c", "swap")
    assert check.replace("!", "") in afters(C, ".c", "comparison")
    assert check.replace(")-1", ")1") in afters(C, ".c", "sign")
    assert check.replace(" - v[1]", "") in afters(C, ".c", "dropped")
    line = 'return {"x < y": 2.0 * body.alpha + lower[0]} if body.n > 3 else min(lower)'
    assert line.replace("body.alpha", "0.5 * body.alpha") in afters(PYTHON, ".py", "unit")
    assert line.replace("min(", "max(") in afters(PYTHON, ".py", "swap")
    assert line.replace("> 3", "< 3") in afters(PYTHON, ".py", "comparison")


@pytest.mark.parametrize("seed", [0, 7])
def test_a_seed_yields_the_same_mutants_each_once(seed):
    first, second = ([m.key for m in itertools.islice(sample_mutants(ROOT, seed), 200)] for _ in range(2))
    assert first == second
    assert len(set(first)) == 200
    assert first != [m.key for m in itertools.islice(sample_mutants(ROOT, seed + 1), 200)]


def test_sixty_mutants_reach_every_file_and_every_kind():
    drawn = list(itertools.islice(sample_mutants(ROOT, 1), 60))
    assert {m.file for m in drawn} == {str(path.relative_to(ROOT)) for path in source_files(ROOT)}
    assert set(Counter(m.kind for m in drawn)) == set(KINDS)
    for m in drawn:
        source = (ROOT / m.file).read_text()
        assert m.text != source
        assert m.before != m.after
        assert m.before.split() == " ".join(source.splitlines()[m.line - 1 :]).split()[: len(m.before.split())]


def test_mutants_of_python_are_mostly_valid():
    drawn = list(itertools.islice(sample_mutants(ROOT, 3, ("src/dualbrain/safety/cbf/kernel.py",)), 60))
    good = 0
    for m in drawn:
        try:
            good += bool(ast.parse(m.text))
        except SyntaxError:
            continue
    assert good > 50


def test_verdicts():
    rows = [{"test": "a", "cpu": 1.0}, {"test": "a", "outcome": "passed", "cpu": 2.0}, {"test": "b", "cpu": 2.0}]
    failed = [*rows, {"test": "b", "outcome": "failed", "cpu": 3.0}]
    assert classify_run(0, rows).caught is False
    assert (classify_run(1, failed).by, classify_run(1, failed).test, classify_run(1, failed).seconds) == (
        "test",
        "b",
        3.0,
    )
    assert (classify_run(-signal.SIGSEGV, rows).by, classify_run(-signal.SIGSEGV, rows).test) == ("crash", "b")
    assert classify_run(-signal.SIGXCPU, rows).by == "timeout"
    assert (classify_run(4, []).by, classify_run(4, []).test) == ("error", "collection")


def test_unevaluated_annotations_are_ignored():
    text = "def f(x: int) -> list[int]:\n    return x[1]\n"
    assert (
        evaluated_code(text)
        == evaluated_code(text.replace("list[int]", "list[0]"))
        == evaluated_code(text.replace("x: int", "x: str"))
    )
    assert evaluated_code(text) != evaluated_code(text.replace("x[1]", "x[0]"))
    assert evaluated_code("class A:\n    x: int\n") != evaluated_code("class A:\n    x: str\n"), (
        "annotations of class fields are evaluated"
    )
