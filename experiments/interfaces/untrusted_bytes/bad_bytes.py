"""Bad values at every interface that takes bytes or text, and their declared outcomes.

Contracts, messages, files, recordings, tables, ledgers, documents, requests and instructions: a bad value is refused by
an error of dualbrain or by a value, or taken in a form that is usable (a number in its domain, a text without hidden
characters). Anything else is a surprise: another exception, a wrong acceptance, or more than `LONGEST` of time.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.errors import DualbrainError
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.interfaces.fuzz_socket import _checker_and_request as checker_and_request
from experiments.interfaces.untrusted_bytes.contract_interfaces import contract_interfaces
from experiments.interfaces.untrusted_bytes.file_interfaces import file_interfaces
from experiments.interfaces.untrusted_bytes.interface import ByteInterface, Refusal, Surprise
from experiments.interfaces.untrusted_bytes.message_interfaces import message_interfaces
from experiments.interfaces.untrusted_bytes.mutation import KINDS, VALID
from experiments.interfaces.untrusted_bytes.record_interfaces import record_interfaces
from experiments.interfaces.untrusted_bytes.text_interfaces import text_interfaces

CASES_PER_UNIT, UNITS = 1000, 1000
"""One million cases in all."""
CONTROL_SHARE = 0.1
LONGEST = 5.0
"""Longest processor time of one case [s]."""
MAX_GROWTH_MIB = 400
"""Largest growth of the memory of the process within one unit [MiB]."""


@cache
def all_interfaces() -> dict[str, ByteInterface]:
    """The interfaces of this process, with files in a temporary folder."""
    folder = Path(_temporary_folder().name)
    checker, request = checker_and_request()
    return (
        contract_interfaces(checker, request)
        | message_interfaces(request)
        | file_interfaces(folder)
        | record_interfaces(folder)
        | text_interfaces()
    )


@cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="dualbrain-bytes-")


def run_case(interface: ByteInterface, kind: str, rng: np.random.Generator) -> str | None:
    """The problem of one case, "" for a declared outcome, None if the interface has no value of this kind."""
    data = interface.mutate(kind, rng)
    if data is None:
        return None
    began = time.process_time()
    try:
        interface.read(data)
    except (DualbrainError, Refusal) as error:
        problem = f"refused a valid input: {str(error)[:200]}" if kind == VALID else ""
    except Surprise as error:
        problem = str(error)
    except Exception as error:
        problem = f"raised {type(error).__name__}: {str(error)[:200]}"
    else:
        problem = "accepted it" if kind in interface.refuses else ""
    spent = time.process_time() - began
    return problem or (f"took {spent:.1f} s" if spent > LONGEST else "")


class BadBytes:
    """One million bad values at every interface that takes bytes or text."""

    name = "bad_bytes"
    claim = "Every bad value in bytes from outside is refused, or taken in a form that is usable, within bounded time."

    def units(self, options: Options) -> list[WorkUnit]:
        """Units of 1000 cases with their own seeds."""
        del options
        return [WorkUnit(f"seed {seed}", {"seed": seed, "cases": CASES_PER_UNIT}) for seed in range(UNITS)]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the cases of one seed; the row counts them by interface and kind and lists the surprises."""
        rng, interfaces = np.random.default_rng(parameters["seed"]), all_interfaces()
        shares = np.array([one.share for one in interfaces.values()])
        names, shares = list(interfaces), shares / shares.sum()
        counts, kinds, problems = Counter[str](), Counter[str](), list[str]()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        while counts.total() < parameters["cases"]:
            name = names[int(rng.choice(len(names), p=shares))]
            kind = VALID if rng.random() < CONTROL_SHARE else KINDS[int(rng.integers(len(KINDS)))]
            if (problem := run_case(interfaces[name], kind, rng)) is None:
                continue
            counts[name] += 1
            kinds[kind] += 1
            if problem:
                problems.append(f"{name}, {kind}: {problem}")
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
        if grown > MAX_GROWTH_MIB:
            problems.append(f"the memory grew by {grown} MiB")
        return {
            "cases": counts.total(),
            "interfaces": dict(counts),
            "kinds": dict(kinds),
            "problems": problems,
            "grown_mib": grown,
        }

    def summarize_row(self, row: Row) -> str:
        """The number of cases and of surprises."""
        return f"{row['cases']} cases, {len(row['problems'])} surprises"

    def report(self, rows: list[Row]) -> list[str]:
        """Cases and surprises by interface and by kind."""
        done = [row for row in rows if "problems" in row]
        lines: list[str] = []
        for title, key in (("interface", "interfaces"), ("kind of value", "kinds")):
            total = sum((Counter(row[key]) for row in done), Counter[str]())
            cells = [[name, f"{count:,}"] for name, count in sorted(total.items())]
            lines += [*markdown_table([title, "cases"], [*cells, ["all", f"{total.total():,}"]]), ""]
        problems = [problem for row in done for problem in row["problems"]]
        return [*lines, f"{len(problems)} surprises.", *(f"- {problem}" for problem in problems[:20])]
