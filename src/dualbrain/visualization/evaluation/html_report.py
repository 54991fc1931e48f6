"""The report of an evaluation: one HTML file that works offline and holds no script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.evaluation.analysis.hypotheses import Answer, answers
from dualbrain.evaluation.planners.answer_cache import Kept
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import adapters_of
from dualbrain.evaluation.report.all_tables import all_grids
from dualbrain.evaluation.report.captions import headline
from dualbrain.evaluation.report.decision_latency import latencies_of
from dualbrain.evaluation.report.not_measured import missing
from dualbrain.evaluation.report.tables import WALL_TIME, Grid
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.visualization.evaluation.charts import curves, latencies, traced_pair, traces
from dualbrain.visualization.html.page import Html, badge, document, element, join, section, table

TONES = {"supported": "good", "refuted": "bad", "undecided": "warn", "not measured": "quiet"}
WIDTH = 480
LATENCY = (
    f"share of measurements below; kept answers are not counted; gate and filter: {WALL_TIME}, so that the longest are "
    "the turns that others had on it; nobody waits in a simulation, and none is a missed deadline. What a step of the "
    "kernel takes of the processor at most: docs/kernel.md"
)
OWN = ("dualbrain", "code", "kernel", "prompt", "short prompt", "python")
"""Parts of an origin that are told one by one; the others are packages."""
UNNAMED = "not recorded"


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture of a failed episode: the row it belongs to, its words, `rgb` (height, width, 3) uint8."""

    row: Row
    caption: str
    rgb: NDArray[np.uint8]


@dataclass(frozen=True)
class Told:
    """What a report is made of; `kept` are the answers of all questions that were really asked.

    `left_out` says what lies there and could not be read or shown.

    Tables and charts are made once, for both forms of a report.
    """

    rows: Sequence[Row]
    suite: Suite
    config: dict[str, Any]
    kept: Sequence[Kept] = ()
    gallery: Sequence[Shot] = ()
    date: str = ""
    command: str = ""
    left_out: Sequence[str] = ()

    @cached_property
    def found(self) -> list[Answer]:
        """The verdicts."""
        return list(answers(self.rows))

    @cached_property
    def grids(self) -> list[Grid]:
        """All tables, the verdicts first."""
        return list(all_grids(self.rows, self.config, self.kept))

    @cached_property
    def missing(self) -> list[str]:
        """What was not measured."""
        return [*missing(self.rows, self.suite, adapters_of(self.config)), *self.left_out]

    @property
    def traced(self) -> str:
        """The place of the chart of one place, "" where no row has kept its curves."""
        return traced_pair(self.rows)

    @cached_property
    def curves(self) -> Html:
        """The chart over repetitions."""
        return curves(self.rows)

    @cached_property
    def traces(self) -> Html:
        """The chart of one place."""
        return traces(self.rows)

    @cached_property
    def latencies(self) -> Html:
        """The chart of latencies."""
        return latencies(self.rows, latencies_of(self.kept))


def write_evaluation(path: Path, told: Told) -> None:
    """Write the report of `told` to `path`."""
    path.write_text(render_evaluation(told), encoding="utf-8")


def render_evaluation(told: Told) -> str:
    """The report as HTML."""
    first, *rest = told.grids
    parts = (
        _header(told),
        element("div", *map(_tile, told.found), class_="tiles"),
        _grid(first),
        _grid(rest[0]),
        _card("Over repetitions", told.curves, "mean with its 95 % interval; a scene is repeated in its run"),
        *map(_grid, rest[1:4]),
        *([_card("One place", told.traces, traces_words(told))] if told.traced else []),
        _gallery(told.gallery),
        _card("Latency", told.latencies, LATENCY),
        *map(_grid, rest[4:]),
        section("What was not measured", element("ul", *(element("li", line) for line in told.missing))),
        _origin(told),
    )
    return document(f"Evaluation {told.suite.name}", *parts)


def _header(told: Told) -> Html:
    suite = told.suite
    where = f"suite {suite.name} · {told.date} · {len(told.rows)} episodes · {', '.join(suite.robots)}"
    names = ", ".join(sorted({row.planner.partition(" (")[0] for row in told.rows if row.planner}))
    return element(
        "header", element("p", where, class_="overline"), element("h1", "Does the loop do what the paper says?"),
        element("p", f"{suite.says} Planners: {names}.", class_="muted"),
    )  # fmt: skip


def _tile(answer: Answer) -> Html:
    return element(
        "div", element("b", answer.name, " ", badge(answer.verdict, TONES[answer.verdict])),
        element("span", answer.says), class_="tile",
    )  # fmt: skip


def _grid(grid: Grid) -> Html:
    return section(grid.title, *(table(head, rows) for head, rows in grid.parts()), note=grid.note)


def _card(title: str, chart: Html, note: str) -> Html:
    return section(title, element("div", chart, class_="card chart"), note=note)


def _gallery(shots: Sequence[Shot]) -> Html:
    if not shots:
        return Html("")
    figures = (_figure(shot) for shot in shots)
    note = "fly one again: dualbrain evaluate --out DIR --again KEY"
    return section(
        "Failures, and successes with a violation", element("div", *figures, class_="shots three"), note=note
    )


def _figure(shot: Shot) -> Html:
    words = join((element("b", f"{shot.row.method}: {headline(shot.row)}"), shot.caption, element("br"),
                  element("code", shot.row.key)))  # fmt: skip
    picture = "data:image/jpeg;base64," + base64.b64encode(jpeg(shot.rgb)).decode()
    return element("figure", element("img", src=picture, alt=shot.caption), element("figcaption", words))


def jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """A picture (height, width, 3), made about `WIDTH` wide, as the bytes of a JPEG file."""
    from matplotlib.image import imsave  # noqa: PLC0415  (heavy imports are lazy)

    step = max(1, round(rgb.shape[1] / WIDTH))
    data = BytesIO()
    imsave(data, np.ascontiguousarray(rgb[::step, ::step]), format="jpeg", pil_kwargs={"quality": 86})
    return data.getvalue()


def traces_words(told: Told) -> str:
    """Which place the traces are of, and how to read them."""
    return f"{told.traced}; methods that did the same share a line; × : a violation begins, on truth"


def facts(told: Told) -> dict[str, str]:
    """Where the results come from: code, machine, versions, planners, ε; a run may lack some of these."""
    origin = {name: str(value) for name, value in told.config.get("origin", {}).items()}
    host = {name: str(value) for name, value in told.config.get("host", {}).items()}
    here = [origin.pop("machine", ""), *(host.get(name, "") for name in ("processor", "memory"))]
    if "cores" in host:
        here.append(f"{host['cores']} cores")
    found = {"revision": host.get("revision", UNNAMED)}
    found |= {name: origin.pop(name) for name in OWN if name in origin}
    found |= {"machine": ", ".join(part for part in here if part) or UNNAMED}
    found |= {"packages": ", ".join(f"{name} {version}" for name, version in origin.items()) or UNNAMED}
    found |= {"planners": ", ".join(f"{part}: {name}" for part, name in told.suite.planners.items())}
    limits: dict[str, dict[str, None]] = {}
    for row in told.rows:
        if row.epsilon is not None:
            limits.setdefault(f"{row.epsilon:.3g} on {row.robot}", {})[row.method] = None
    if limits:
        found["ε"] = "; ".join(f"{limit} ({', '.join(methods)})" for limit, methods in limits.items())
    return found | ({"again": told.command} if told.command else {})


def _origin(told: Told) -> Html:
    known = facts(told).items()
    listed = element("dl", *(join((element("dt", name), element("dd", element("code", one)))) for name, one in known))
    whole = msgspec.json.format(msgspec.json.encode(told.config), indent=2).decode()
    details = element("details", element("summary", "The whole configuration"), element("pre", whole))
    remark = "Simulation only. What is said of safety holds for the model the filter was given (SAFETY.md)."
    return section("Where this comes from", listed, details, element("footer", remark))
