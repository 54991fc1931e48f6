"""Checks of the documents: snippets run, links have a target, named code and tests exist, options are documented."""

import ast
import inspect
import re
from functools import cache
from pathlib import Path
from typing import get_args

import pytest
from cyclopts import Parameter

from dualbrain.cli.adapters.adapt import adapt
from dualbrain.cli.adapters.export import diff, export
from dualbrain.cli.adapters.make import make
from dualbrain.cli.adapters.measure import measure
from dualbrain.cli.adapters.registry import history, list_adapters, promote, rollback, verify
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.evaluation.export_lerobot import export_lerobot
from dualbrain.cli.run.check import check
from dualbrain.cli.run.demo import demo
from dualbrain.cli.run.plan import plan
from dualbrain.cli.run.replay import replay
from dualbrain.cli.run.run import run
from dualbrain.cli.run.schema import schema
from dualbrain.core.weights import MANIFEST
from dualbrain.evaluation.protocol.method import MAIN_METHODS

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("kernel/**/*.md")])
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
NAMED = re.compile(r"`((?:src|kernel|tests)/[\w./]+\.(?:py|c|h)):([\w.]+)`")
PLACE = re.compile(r"`((?:src|kernel|tests|docs|examples|benchmarks|vectors)/[\w./]+\.\w+)`")


def page_name(page):
    return page.relative_to(ROOT).as_posix()


def snippets():
    """One test case for every fenced block of Python."""
    cases = []
    for page in PAGES:
        for number, (language, code) in enumerate(FENCE.findall(page.read_text("utf-8")), start=1):
            if language == "python":
                cases.append(pytest.param(code, id=f"{page_name(page)}-{number}"))
    return cases


def on_disk(path):
    """The file that a page refers to: `src/x/file.py` is short for `src/dualbrain/x/file.py`."""
    short = ROOT / re.sub(r"^src/(?!dualbrain/)", "src/dualbrain/", path)
    return short if short.exists() else ROOT / path


@cache
def defined(path):
    """Names that a file defines: functions, classes and methods (`Class.method`) of Python, functions of C."""
    text = path.read_text("utf-8")
    if path.suffix != ".py":
        return frozenset(re.findall(r"^(?:DBK_SIMD_CLONES )?[a-z][\w \*]*?\b(\w+)\(", text, re.MULTILINE))
    found = set()
    for node in ast.parse(text).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
    return frozenset(found)


def anchors(page):
    """Anchors of the headings of a page, as usual renderers make them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("code", snippets())
def test_a_python_snippet_runs(code, capsys):
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})
    assert capsys.readouterr().err == ""


def test_there_are_snippets():
    assert snippets()


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_have_a_target(page):
    for target in LINK.findall(FENCE.sub("", page.read_text("utf-8"))):
        if "://" in target:
            continue
        place, _, anchor = target.partition("#")
        found = (page.parent / place).resolve() if place else page
        assert found.exists(), f"{page_name(page)} links to {target}"
        if anchor:
            assert anchor in anchors(found), f"{page_name(page)} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_named_code_and_tests_exist(page):
    text = page.read_text("utf-8")
    for path, name in NAMED.findall(text):
        file = on_disk(path)
        assert file.is_file(), f"{page_name(page)} names {path}"
        assert name in defined(file), f"{page_name(page)} names {path}:{name}"
    for path in PLACE.findall(text):
        assert on_disk(path).exists(), f"{page_name(page)} names {path}"


def test_every_row_of_the_paper_map_names_code_and_a_test():
    held = (ROOT / "docs" / "reference" / "paper.md").read_text("utf-8").split("## Not in this version")[0]
    rows = [line.split(" | ") for line in held.splitlines() if re.match(r"\| (\d|Prop)", line)]
    assert len(rows) > 20
    for row in rows:
        if "`pyproject.toml`" not in row[2]:
            assert NAMED.findall(row[2]), row
            assert all(path.startswith("tests/") for path, _ in NAMED.findall(row[3])), row
            assert NAMED.findall(row[3]), row


def test_the_readme_names_every_model_with_its_licence():
    table = (ROOT / "README.md").read_text("utf-8").split("## Licence")[1]
    for name, file in MANIFEST.items():
        if not name.endswith("-tokenizer"):
            row = next(line for line in table.splitlines() if f"`{name}`" in line)
            assert row.endswith(f"{file.licence} |")


def test_the_page_of_commands_has_every_exit_code():
    page = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)} == {int(code) for code in ExitCode}


def test_no_page_contains_a_path_of_one_machine():
    for page in PAGES:
        assert not re.search(r"(?<![\w.])/(?:work|home|root|tmp|opt)/", page.read_text("utf-8")), page_name(page)


def option_name(parameter):
    """The option of a keyword-only parameter: the name in its annotation if there is one, else its own name."""
    annotated = [one.name[0] for one in get_args(parameter.annotation) if isinstance(one, Parameter) and one.name]
    return annotated[0] if annotated else f"--{parameter.name.replace('_', '-')}"


@pytest.mark.parametrize(
    "command", [run, demo, check, schema, replay, export_lerobot], ids=lambda command: command.__name__
)
def test_the_page_of_commands_has_every_option(command):
    page = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
    section = page.split(f"\n## {command.__name__.removesuffix('_lerobot')}\n")[1].split("\n## ")[0]
    parameters = inspect.signature(command, eval_str=True).parameters.values()
    options = {option_name(parameter) for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY}
    assert options <= set(re.findall(r"--[\w-]+", section))


@pytest.mark.parametrize(
    "command", [plan, adapt, list_adapters, history, verify, measure, promote, rollback, diff, export, make]
)
def test_the_usage_of_planning_and_adapter_commands_has_every_option(command):
    page = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
    name = command.__name__.removesuffix("_adapters")
    section = page.split(f"\n## {name if command in {plan, adapt} else 'adapters'}\n")[1].split("\n## ")[0]
    usages = re.split(r" \| |`", " ".join(section.split()))
    usage = next(one for one in usages if re.match(rf"(dualbrain )?(adapters )?{name} .*--", one))
    for one in inspect.signature(command).parameters.values():
        if one.kind is one.KEYWORD_ONLY:
            assert f"--{'no-' * (one.default is True)}{one.name.replace('_', '-')}" in usage


def test_the_glossary_defines_every_method_of_the_main_table():
    page = (ROOT / "docs" / "reference" / "glossary.md").read_text("utf-8")
    rows = re.findall(r"^\| (\w+) \|", page.split("\n### Methods\n")[1].split("\n### ")[0], re.MULTILINE)
    assert {method.name for method in MAIN_METHODS} <= set(rows)
