"""Each rule on names and layout finds its violation, and nothing in a tree without one."""

import subprocess

import pytest

from tools.structure.__main__ import RULES, Tree

CLEAN = {
    "src/dualbrain/__init__.py": '"""Package."""\n',
    "src/dualbrain/first.py": '"""First module."""\n\nVALUE = 1\n',
    "src/dualbrain/second.py": '"""Second module."""\n\nfrom dualbrain.first import VALUE\n\nTWICE = 2 * VALUE\n',
    "docs/old.md": "It was flown.\n",
    "docs/index.md": "# Page\n\nThe filter modifies a control.\n",
    "tools/structure/rules.toml": "[folders]\n[records]\n[words]\n"
    'where = ["src/", "docs/"]\nsuffixes = [".py", ".md"]\n[words.use]\n"episode, run" = ["flown"]\n',
    "tools/structure/allowed/docs.toml": '[[allowed]]\nfile = "docs/old.md"\nwords = ["flown"]\nreason = "quoted"\n',
}
FIVE_FIELDS = "    a: int\n    b: int\n    c: int\n    d: int\n    e: int\n"
VIOLATIONS = {
    "folders": (
        {f"src/dualbrain/many/part_{i}.py": '"""Part."""\n' for i in range(13)},
        "src/dualbrain/many: 13 entries",
    ),
    "cycles": (
        {"src/dualbrain/first.py": '"""First module."""\n\nfrom dualbrain import second\n\nVALUE = 1\n'},
        "import cycle: dualbrain.first ↔ dualbrain.second",
    ),
    "records": (
        {"src/dualbrain/third.py": f'"""Third."""\n\n\n@dataclass\nclass Five:\n    """Five."""\n\n{FIVE_FIELDS}'},
        "src/dualbrain/third.py:5: Five has 5 fields",
    ),
    "words": (
        {"src/dualbrain/third.py": '"""Third."""\n\nepisodes_flown = 1\n'},
        "third.py:3: 'flown': use 'episode, run'",
    ),
    "allowed": (
        {
            "tools/structure/allowed/more.toml": '[[allowed]]\nfile = "docs/index.md"\nwords = ["flown"]\n'
            'reason = "a title"\n'
        },
        "exception for docs/index.md (a title): no occurrence of flown",
    ),
    "docs": ({"src/dualbrain/third.py": '"""Third."""\n\n\ndef public():\n    pass\n'}, "public has no docstring"),
}


@pytest.fixture
def findings(tmp_path):
    """A function that writes files to a new checkout, and returns the findings of every rule."""

    def check(files):
        for name, text in {**CLEAN, **files}.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
        tree = Tree.of(tmp_path)
        return {rule: list(check(tree)) for rule, check in RULES.items()}

    return check


def test_a_tree_that_follows_the_rules_has_no_finding(findings):
    assert findings({}) == {rule: [] for rule in RULES}


@pytest.mark.parametrize("rule", RULES)
def test_a_violation_is_found_by_its_rule_only(findings, rule):
    files, expected = VIOLATIONS[rule]
    found = findings(files)
    assert len(found.pop(rule)) == 1
    assert expected in findings(files)[rule][0]
    assert not any(found.values())


def five(decorator, bases, fields=FIVE_FIELDS):
    """A module with a class `Five`."""
    return f'"""Third."""\n\n\n{decorator}\nclass Five{bases}:\n    """Five."""\n\n{fields}'


BASE_STRUCT = '"""Base."""\n\n\nclass Base(msgspec.Struct, frozen=True):\n    """Base."""\n\n    z: int\n'
EXPORT = '"""Base."""\n\nfrom dualbrain.lowest import Base\n\n__all__ = ["Base"]\n'
IMPORT = "from dualbrain.exported import Base\n"
FOUR_FIELDS = FIVE_FIELDS.removesuffix("    e: int\n")


@pytest.mark.parametrize("top", ["src/dualbrain", "experiments", "benchmarks", "tools"])
@pytest.mark.parametrize(
    ("text", "count"),
    [
        (five("@dataclass", ""), 5),
        (five("@dataclass(frozen=True)", ""), 5),
        (five("", "(msgspec.Struct, frozen=True)"), 5),
        (five("", "(NamedTuple)"), 5),
        (five(IMPORT, "(Base, frozen=True)"), 6),
        (five(IMPORT, "(Base, frozen=True)", FOUR_FIELDS), 5),
        (five("@dataclass(kw_only=True)", ""), 0),
        (five("@dataclass", "", "    a: int\n    _: KW_ONLY\n" + FIVE_FIELDS[11:]), 0),
        (five("@dataclass", "", FOUR_FIELDS + "    e: int = field(kw_only=True)\n"), 0),
        (five("@dataclass", "", FOUR_FIELDS + "    e: ClassVar[int] = 1\n"), 0),
        (five("", "(NamedTuple)", FOUR_FIELDS), 0),
        (five(IMPORT, "(Base, frozen=True, kw_only=True)"), 0),
        (five("", "(Protocol)"), 0),
    ],
)
def test_records_with_more_than_four_positional_fields_are_found(findings, top, text, count):
    base = {"src/dualbrain/lowest.py": BASE_STRUCT, "src/dualbrain/exported/__init__.py": EXPORT}
    found = findings({**base, f"{top}/third.py": text})["records"]
    assert len(found) == (count > 0)
    assert not found or f"{top}/third.py" in found[0]
    assert not found or f"Five has {count} fields" in found[0]


def test_records_are_exempt_where_a_reason_is_given(findings):
    rules = CLEAN["tools/structure/rules.toml"].replace(
        "[records]", '[records]\n"dualbrain.third.Five" = "a table row"'
    )
    files = {"tools/structure/rules.toml": rules, "src/dualbrain/third.py": five("", "(NamedTuple)")}
    assert findings(files)["records"] == []


def test_words_are_allowed_where_a_reason_is_given(findings):
    assert findings({})["words"] == []
    assert len(findings({"docs/new.md": "It was flown.\n"})["words"]) == 1


def test_imports_for_types_only_are_no_cycle(findings):
    guarded = "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from dualbrain import second\n"
    assert findings({"src/dualbrain/first.py": f'"""First module."""\n\n{guarded}\nVALUE = 1\n'})["cycles"] == []
