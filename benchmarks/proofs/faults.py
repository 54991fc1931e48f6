"""Injected faults: source × kind × moment × scene, each with the order that was declared beforehand."""

from __future__ import annotations

from collections import Counter
from itertools import product
from typing import Any

import msgspec

from dualbrain.runtime.fault_trial import inject
from dualbrain.runtime.faults import KINDS, MOMENTS, SOURCES, Fault
from proofs.proof import Options, Row, Unit

SCENES = ("bare:0", "tabletop:1", "forearm:0")
"""Nothing but the errand; neighbours; a person's forearm that crosses."""


class Faults:
    """Nothing unsafe, whatever breaks at the worst moment, and the declared order comes."""

    name = "faults"
    claim = (
        "Whatever breaks, in whatever way, at the worst moment: the declared order (or a stronger one) comes, and the "
        "independent monitor sees nothing unsafe."
    )

    def units(self, options: Options) -> list[Unit]:
        """7 sources × 7 kinds × 6 moments × 3 scenes = 882, so mixed that any prefix covers all sources."""
        del options
        cells = list(product(SCENES, MOMENTS, KINDS, SOURCES))
        order = sorted(range(len(cells)), key=lambda k: (k * 283) % len(cells))
        return [
            Unit(f"{scene}/{source}/{kind}/{moment}", {"scene": scene, "fault": [source, kind, moment]})
            for scene, moment, kind, source in (cells[k] for k in order)
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """One injected episode."""
        report = inject(Fault(*about["fault"]), scene=about["scene"])
        return {**msgspec.to_builtins(report), "safe": report.safe, "as_declared": report.as_declared}

    def brief(self, row: Row) -> str:
        """For the progress line."""
        good = "safe" if row["safe"] else "UNSAFE"
        return f"{good}, expected {row['expected']}, reached {row['reached']}, {row['outcome']}"

    def report(self, rows: list[Row]) -> list[str]:
        """By source and kind; every exception by name."""
        struck = [row for row in rows if row["struck"] is not None]
        lines = [
            f"Episodes: **{len(rows)}**, of which {len(struck)} reached their moment. Unsafe: "
            f"**{sum(not row['safe'] for row in struck)}**. Declared order did not come: "
            f"**{sum(not row['as_declared'] for row in struck)}**.", "",
            "| source | kind | struck | orders reached | reaction, worst | at rest after, worst | outcomes |",
            "|---|---|---|---|---|---|---|",
        ]  # fmt: skip
        cells: dict[tuple[str, str], list[Row]] = {}
        for row in struck:
            source, kind, *_ = row["fault"].split()
            cells.setdefault((source, kind), []).append(row)
        lines += [_line(source, kind, group) for (source, kind), group in sorted(cells.items())]
        bad = [row for row in struck if not (row["safe"] and row["as_declared"])]
        return lines + [""] + [f"- {row['key']}: {self.brief(row)}; {row['reason']}; {row['unsafe']}" for row in bad]


def _line(source: str, kind: str, rows: list[Row]) -> str:
    reaction = max((row["reaction"] for row in rows if row["reaction"] is not None), default=None)
    stopped = [row for row in rows if row["outcome"] in ("stopped", "emergency")]
    rest = max((row["rest"] for row in stopped if row["rest"] is not None), default=None)
    reached = ", ".join(f"{name} {count}" for name, count in Counter(row["reached"] for row in rows).most_common())
    outcomes = ", ".join(f"{name} {count}" for name, count in Counter(row["outcome"] for row in rows).most_common())
    told = [f"{1e3 * value:.0f} ms" if value is not None else "–" for value in (reaction, rest)]
    return f"| {source} | {kind} | {len(rows)} | {reached} | {told[0]} | {told[1]} | {outcomes} |"
