"""Tables of the mutation test, and docs/reference/verification/mutants.md."""

from __future__ import annotations

import tomllib
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

REASONS_FILE = Path(__file__).with_name("survivors.toml")
"""Explanations of surviving mutants: [[survivor]] with file, before, after, kind ("equivalent" or "gap"), why."""
METHOD = """Each mutant changes one place in `kernel/src/**/*.c` or `safety/cbf/kernel.py`, in a copy of the project,
which is compiled again. `tests/safety`, `tests/invariants` and `tests/kernel/test_buffer_capacity.py` run until the
first failure; tests that compare every value of a step with its definition run first. Recorded results (golden
hashes, vectors) and comparisons of builds are excluded: they detect every changed bit and test no property. A mutant
counts as equivalent only with an explanation below. Equivalent mutants remain in the denominator of the detected
share; the share without them is given as well. Mutants with the object code of the original are counted separately."""


def summary(rows: list[dict]) -> dict[str, object]:
    """Return the counts of outcomes, and the detected share of the tested mutants."""
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
    """Return the identity of a surviving mutant, valid while its line is unchanged."""
    return row["file"], row["before"], row["after"]


def load_reasons() -> dict[tuple[str, str, str], dict]:
    """Return the explanations of surviving mutants."""
    entries = tomllib.loads(REASONS_FILE.read_text()).get("survivor", []) if REASONS_FILE.exists() else []
    return {survivor_key(entry): entry for entry in entries}


def report_table(facts: dict, rows: list[dict]) -> list[str]:
    """Return counts, tables by kind and file, and every surviving mutant with its explanation."""
    lines = [
        f"{facts['tested']} mutants tested (seed {facts['seed']}): {facts['caught']} detected "
        f"({100 * facts['caught_share']:.1f} %), {facts['survived']} survived ({facts['equivalent']} equivalent; "
        f"without these {100 * facts['caught_of_real']:.1f} % detected).",
        f"Counted separately: {facts['does_not_compile']} did not compile, {facts['same_object_code']} had the same "
        f"object code. Detected by: {', '.join(f'{k} {v}' for k, v in facts['by'].items())}.",
        "",
    ]
    for title, field in (("kind", "kind"), ("file", "file")):
        lines += [f"| {title} | tested | detected |", "|---|---|---|"]
        tested = [row for row in rows if row["outcome"] in ("caught", "survived")]
        for value in sorted({row[field] for row in tested}):
            here = [row for row in tested if row[field] == value]
            lines.append(f"| {value} | {len(here)} | {sum(row['outcome'] == 'caught' for row in here)} |")
        lines.append("")
    return lines + survivor_list(rows)


def survivor_list(rows: list[dict]) -> list[str]:
    """Return the list of mutants that no test detected: change and explanation."""
    known, lines = load_reasons(), []
    for row in (row for row in rows if row["outcome"] == "survived"):
        reason = known.get(survivor_key(row), {"kind": "not explained", "why": ""})
        position = f"`{row['file']}`, line {row['line']} ({row['kind']})"
        lines += [
            f"- {position}: **{reason['kind']}**. {reason['why']}".rstrip(),
            "  ```diff",
            f"  - {row['before']}",
            f"  + {row['after']}",
            "  ```",
        ]
    return ["Surviving mutants:", "", *lines] if lines else ["No surviving mutants."]


def write_document(path: Path, facts: dict, rows: list[dict]) -> None:
    """Write docs/reference/verification/mutants.md with date, revision and every mutant."""
    every = ["| position | kind | changed line | detected by |", "|---|---|---|---|"]
    for row in rows:
        if row["outcome"] in ("caught", "survived"):
            after = row["after"].replace("|", "\\|")
            by = row["test"].replace("tests/", "") if row["by"] == "test" else f"{row['by']} {row['test']}".strip()
            every.append(f"| {Path(row['file']).name}:{row['line']} | {row['kind']} | `{after}` | {by or 'nothing'} |")
    head = [
        "# Mutation test",
        "",
        f"Written by `python -m tools.mutation --seed {facts['seed']} --count {facts['tested']} --write-docs` on "
        f"{datetime.now(UTC):%Y-%m-%d}, revision {facts['revision']}.",
        "",
        METHOD,
        "",
    ]
    path.write_text("\n".join([*head, *report_table(facts, rows), "", "## Every mutant", "", *every, ""]))
