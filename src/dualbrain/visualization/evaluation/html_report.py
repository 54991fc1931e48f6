"""HTML report of an evaluation: a single file that works offline and contains no script."""

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

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.evaluation.analysis.hypotheses import HypothesisResult, evaluate_hypotheses
from dualbrain.evaluation.planners.answer_cache import CachedAnswer
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import costs_from_config
from dualbrain.evaluation.report.all_tables import all_tables
from dualbrain.evaluation.report.captions import headline
from dualbrain.evaluation.report.decision_latency import unbatched_latencies
from dualbrain.evaluation.report.not_measured import list_not_measured
from dualbrain.evaluation.report.summary import describe_methods, summary_sentence
from dualbrain.evaluation.report.tables import WALL_TIME_NOTE, Table
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.planner.backends.key_redaction import public_planner
from dualbrain.visualization.evaluation.charts import (
    latencies_chart,
    metrics_chart,
    select_traced_pair,
    summary_chart,
    traces_chart,
)
from dualbrain.visualization.html.page import Html, badge, document, element, join, section, table

VERDICT_TONES = {"supported": "good", "refuted": "bad", "undecided": "warn", "not measured": "quiet"}
IMAGE_WIDTH = 480
CURVES_NOTE = "mean with 95 % interval, the other methods in grey; a run repeats its scenes"
LATENCY_NOTE = (
    "cumulative shares; cached answers are not counted; gate and filter: "
    f"{WALL_TIME_NOTE}, so that the longest times include other processes. The simulation waits for each step, so none "
    "of them is a missed deadline; docs/reference/safety/kernel.md gives the worst-case processor time of a kernel step"
)
PROVENANCE_FIELDS = ("dualbrain", "code", "kernel", "prompt", "local prompt", "short prompt", "python")
"""Provenance entries that are listed one by one; the others are package versions."""
NOT_RECORDED = "not recorded"


@dataclass(frozen=True, slots=True)
class FailureImage:
    """Image of a failed episode: the row it belongs to, a caption, `rgb` (height, width, 3) uint8."""

    row: EpisodeRow
    caption: str
    rgb: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class ReportData:
    """Contents of a report.

    `cached_answers` are the answers of all requests that reached a planner, `omissions` describe inputs that could not
    be read or shown. Tables and charts are computed once and used by the HTML report and by the Markdown page.
    """

    rows: Sequence[EpisodeRow]
    suite: Suite
    config: dict[str, Any]
    cached_answers: Sequence[CachedAnswer] = ()
    gallery: Sequence[FailureImage] = ()
    date: str = ""
    command: str = ""
    omissions: Sequence[str] = ()

    @cached_property
    def hypotheses(self) -> list[HypothesisResult]:
        """The verdicts."""
        return list(evaluate_hypotheses(self.rows))

    @cached_property
    def tables(self) -> list[Table]:
        """All tables, the verdicts first."""
        return list(all_tables(self.rows, self.config, self.cached_answers))

    @cached_property
    def not_measured(self) -> list[str]:
        """Sentences about what was not measured."""
        return [*list_not_measured(self.rows, self.suite, costs_from_config(self.config)), *self.omissions]

    @property
    def traced_pair(self) -> str:
        """Case whose traces are drawn, "" if no row contains traces."""
        return select_traced_pair(self.rows)

    @cached_property
    def summary(self) -> str:
        """The result in one sentence."""
        return summary_sentence(self.rows)

    @cached_property
    def bars(self) -> Html:
        """Chart of success and violations by method."""
        return summary_chart(self.rows)

    @cached_property
    def curves(self) -> Html:
        """Chart of the metrics over repetitions."""
        return metrics_chart(self.rows)

    @cached_property
    def traces(self) -> Html:
        """Chart of the traces of one case."""
        return traces_chart(self.rows)

    @cached_property
    def latencies(self) -> Html:
        """Chart of the latencies."""
        return latencies_chart(self.rows, unbatched_latencies(self.cached_answers))


def write_html_report(path: Path, data: ReportData) -> None:
    """Write the report of `data` to `path`."""
    write_atomically(path, render_html_report(data).encode())


def render_html_report(data: ReportData) -> str:
    """Text of the report as HTML."""
    first, *rest = data.tables
    parts = (
        _header(data),
        element("p", data.summary, class_="lead"),
        element("div", data.bars, element("p", describe_methods(data.rows), class_="muted"), class_="card chart"),
        element("div", *map(_tile, data.hypotheses), class_="tiles"),
        _table_section(first),
        _table_section(rest[0]),
        _chart_section("Metrics over repetitions", data.curves, CURVES_NOTE),
        *map(_table_section, rest[1:4]),
        *(
            [_chart_section("Traces of one case", data.traces, traces_caption(data.traced_pair))]
            if data.traced_pair
            else []
        ),
        _gallery_section(data.gallery),
        _chart_section("Latency", data.latencies, LATENCY_NOTE),
        *map(_table_section, rest[4:]),
        section("Not measured", element("ul", *(element("li", line) for line in data.not_measured))),
        _provenance_section(data),
    )
    return document(f"Evaluation {data.suite.name}", *parts)


def _header(data: ReportData) -> Html:
    suite = data.suite
    overline = f"suite {suite.name} · {data.date} · {len(data.rows)} episodes · {', '.join(suite.robots)}"
    names = ", ".join(sorted({row.planner.partition(" (")[0] for row in data.rows if row.planner}))
    return element(
        "header",
        element("p", overline, class_="overline"),
        element("h1", "Evaluation of the closed loop"),
        element("p", f"{suite.description} Planners: {names}.", class_="muted"),
    )


def _tile(result: HypothesisResult) -> Html:
    return element(
        "div",
        element("b", result.name, " ", badge(result.verdict, VERDICT_TONES[result.verdict])),
        element("span", result.description),
        class_="tile",
    )


def _table_section(grid: Table) -> Html:
    return section(grid.title, *(table(header, rows) for header, rows in grid.split_columns()), note=grid.note)


def _chart_section(title: str, chart: Html, note: str) -> Html:
    return section(title, element("div", chart, class_="card chart"), note=note)


def _gallery_section(shots: Sequence[FailureImage]) -> Html:
    if not shots:
        return Html("")
    figures = (_figure(shot) for shot in shots)
    note = "run an episode again: dualbrain evaluate --out DIR --again KEY"
    return section(
        "Failures, and successes with a violation", element("div", *figures, class_="shots three"), note=note
    )


def _figure(shot: FailureImage) -> Html:
    words = join(
        (
            element("b", f"{shot.row.method}: {headline(shot.row)}"),
            shot.caption,
            element("br"),
            element("code", shot.row.key),
        )
    )
    source = "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(shot.rgb)).decode()
    return element("figure", element("img", src=source, alt=shot.caption), element("figcaption", words))


def encode_jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """Bytes of a JPEG file of the image `rgb` (height, width, 3), reduced to about `IMAGE_WIDTH` columns."""
    from matplotlib.image import imsave  # noqa: PLC0415  (heavy imports are lazy)

    step = max(1, round(rgb.shape[1] / IMAGE_WIDTH))
    data = BytesIO()
    imsave(data, np.ascontiguousarray(rgb[::step, ::step]), format="jpeg", pil_kwargs={"quality": 86})
    return data.getvalue()


def traces_caption(pair: str) -> str:
    """Caption of the traces of the case `pair`."""
    return f"{pair}; methods with identical results share a line; × : start of a violation on ground truth"


def provenance_facts(data: ReportData) -> dict[str, str]:
    """Provenance of the results: code, machine, versions, planners, ε. Missing entries read "not recorded"."""
    origin = {name: str(value) for name, value in data.config.get("origin", {}).items()}
    host = {name: str(value) for name, value in data.config.get("host", {}).items()}
    here = [origin.pop("machine", ""), *(host.get(name, "") for name in ("processor", "memory"))]
    if "cores" in host:
        here.append(f"{host['cores']} cores")
    found = {"revision": host.get("revision", NOT_RECORDED)}
    found |= {name: origin.pop(name) for name in PROVENANCE_FIELDS if name in origin}
    found |= {"machine": ", ".join(part for part in here if part) or NOT_RECORDED}
    found |= {"packages": ", ".join(f"{name} {version}" for name, version in origin.items()) or NOT_RECORDED}
    found |= {"planners": ", ".join(f"{part}: {public_planner(name)}" for part, name in data.suite.planners.items())}
    limits: dict[str, dict[str, None]] = {}
    for row in data.rows:
        if row.epsilon is not None:
            limits.setdefault(f"{row.epsilon:.3g} on {row.robot}", {})[row.method] = None
    if limits:
        found["ε"] = "; ".join(f"{limit} ({', '.join(methods)})" for limit, methods in limits.items())
    return found | ({"reproduce": data.command} if data.command else {})


def _provenance_section(data: ReportData) -> Html:
    known = provenance_facts(data).items()
    listed = element("dl", *(join((element("dt", name), element("dd", element("code", one)))) for name, one in known))
    whole = msgspec.json.format(msgspec.json.encode(data.config), indent=2).decode()
    details = element("details", element("summary", "Full configuration"), element("pre", whole))
    remark = "Simulation only. Safety claims hold for the robot model that the filter uses (SAFETY.md)."
    return section("Provenance", listed, details, element("footer", remark))
