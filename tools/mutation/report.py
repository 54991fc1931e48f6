"""What the mutation check found, as a table and as docs/reference/verification/mutants.md."""

from __future__ import annotations

import tomllib
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

REASONS_FILE = Path(__file__).with_name("survivors.toml")
"""Why a survivor survived: entries [[survivor]] with file, before, after, kind ("equivalent" or "gap") and why."""


def summary(rows: list[dict]) -> dict[str, object]:
    """Counts of outcomes, and the share of the tested mutants that were caught."""
    counts = Counter(row["outcome"] for row in rows)
    tested = counts["caught"] + counts["survived"]
    known = load_reasons()
    equivalent = sum(
        row["outcome"] == "survived" and known.get(survivor_key(row), {}).get("kind") == "equivalent" for row in rows
    )
    return {
        "tested": tested,
        "caught": counts["caught"],
        "survived": counts["survived"],
        "equivalent": equivalent,
        "does_not_compile": counts["does not compile"],
        "same_object_code": counts["same object code"],
        "caught_share": counts["caught"] / tested if tested else 0.0,
        "caught_of_real": counts["caught"] / (tested - equivalent) if tested > equivalent else 0.0,
        "by": dict(Counter(row["by"] for row in rows if row["outcome"] == "caught")),
    }


def survivor_key(row: dict) -> tuple[str, str, str]:
    """What a survivor is known by while its line stays the same."""
    return row["file"], row["before"], row["after"]


def load_reasons() -> dict[tuple[str, str, str], dict]:
    """The explanations that people wrote."""
    entries = tomllib.loads(REASONS_FILE.read_text()).get("survivor", []) if REASONS_FILE.exists() else []
    return {survivor_key(entry): entry for entry in entries}


def report_table(facts: dict, rows: list[dict]) -> list[str]:
    """Counts, kinds, files, and every survivor with its reason."""
    lines = [
        f"{facts['tested']} mutants tested (seed {facts['seed']}): {facts['caught']} caught "
        f"({100 * facts['caught_share']:.1f} %), {facts['survived']} survived ({facts['equivalent']} equivalent; "
        f"without these {100 * facts['caught_of_real']:.1f} % caught).",
        f"Counted apart: {facts['does_not_compile']} did not compile, {facts['same_object_code']} gave the same object "
        f"code. Caught by: {', '.join(f'{k} {v}' for k, v in facts['by'].items())}.",
        "",
    ]
    for title, field in (("kind", "kind"), ("file", "file")):
        lines += [f"| {title} | tested | caught |", "|---|---|---|"]
        tested = [row for row in rows if row["outcome"] in ("caught", "survived")]
        for value in sorted({row[field] for row in tested}):
            here = [row for row in tested if row[field] == value]
            lines.append(f"| {value} | {len(here)} | {sum(row['outcome'] == 'caught' for row in here)} |")
        lines.append("")
    return lines + survivor_list(rows)


def survivor_list(rows: list[dict]) -> list[str]:
    """Each mutant that no test noticed: the change, and why."""
    known, lines = load_reasons(), []
    for row in (row for row in rows if row["outcome"] == "survived"):
        reason = known.get(survivor_key(row), {"kind": "not explained yet", "why": ""})
        place = f"`{row['file']}`, line {row['line']} ({row['kind']})"
        lines += [
            f"- {place}: **{reason['kind']}**. {reason['why']}".rstrip(),
            "  ```diff",
            f"  - {row['before']}",
            f"  + {row['after']}",
            "  ```",
        ]
    return ["Survivors:", "", *lines] if lines else ["No survivors."]


def write_document(path: Path, facts: dict, rows: list[dict]) -> None:
    """docs/reference/verification/mutants.md with date, revision and every mutant."""
    every = ["| where | kind | after | caught by |", "|---|---|---|---|"]
    for row in rows:
        if row["outcome"] in ("caught", "survived"):
            after = row["after"].replace("|", "\\|")
            by = row["test"].replace("tests/", "") if row["by"] == "test" else f"{row['by']} {row['test']}".strip()
            every.append(f"| {Path(row['file']).name}:{row['line']} | {row['kind']} | `{after}` | {by or 'nothing'} |")
    head = [
        "# Mutants: do the tests notice a mistake?",
        "",
        f"Written by `python tools/mutation/__main__.py --seed {facts['seed']} --count {facts['tested']} --write-docs` on "
        f"{datetime.now(UTC):%Y-%m-%d}, revision {facts['revision']}.",
        "",
        "One place is changed in `kernel/src/**/*.c` or `safety/cbf/kernel.py`, everything is compiled anew in a scratch",
        "copy, and `tests/safety`, `tests/invariants` and `tests/kernel/test_buffer_capacity.py` run until the first failure;",
        "those go first that hold every number of a step against its definition. Recorded answers (golden hashes,",
        "vectors) and comparisons of builds are left out: they notice every bit and prove no law. A mutant counts",
        "as equivalent only with a reason below; equivalent ones stay in the denominator, and the share without",
        "them is told beside. Mutants whose object code is that of the original are counted apart.",
        "",
    ]
    path.write_text("\n".join([*head, *report_table(facts, rows), "", "## Every mutant", "", *every, ""]))
