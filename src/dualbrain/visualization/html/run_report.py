"""HTML report of one run: a single file that works offline and contains no script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.recording.trace import DEAD_BAND, Event, Trace
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.memory.maintenance.projection import MemoryProjection
from dualbrain.records import Attempt, Episode, Exemplar, MemoryUse, Outcome
from dualbrain.runtime.planning.planning_time import latency_breakdown
from dualbrain.safety.barriers import BARRIERS
from dualbrain.visualization.html.attempts import STATUS_TONES, attempts_section, combine
from dualbrain.visualization.html.key_numbers import (
    KeyNumber,
    format_dimensionless,
    format_millimetres,
    format_seconds,
    key_numbers,
)
from dualbrain.visualization.html.memory_map import memory_map_section
from dualbrain.visualization.html.page import Html, badge, document, element, join, section, table
from dualbrain.visualization.html.strip_chart import strip_chart

GATE_STAGES = ("syntax", "authorization", "envelope")
IMAGE_WIDTH = 960
"""Largest width of an image [pixel]: a click enlarges it to this width."""
NO_INSTRUCTION_TITLE = "a given contract"
MAX_TEXT_CHARACTERS = 4000
MAX_EVENTS = 400
"""Largest number of listed events: of more, the first and the last half of this number."""
NO_CONTROL = "No control was executed, so there is nothing to plot."
TICKS_ELSEWHERE = (
    "The control ticks are not in this report; the gatekeeper records them if it is started with --record."
)
FILTER_OFF_NOTICE = "The safety filter was off: Δ and clearances are only measured."


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Image of the scene at `t` [s]: `rgb` (height, width, 3) uint8."""

    t: float
    caption: str
    rgb: NDArray[np.uint8]


def write_report(
    path: Path,
    episode: Episode,
    trace: Trace,
    snapshots: Sequence[Snapshot] = (),
    projection: MemoryProjection | None = None,
    earlier: Sequence[Episode] = (),
) -> None:
    """Write the report of `episode` to `path`.

    `trace` has no ticks if the gate rejected the contract, or if they are in the recording of a gatekeeper.
    `earlier` are the tries of the same instruction before this episode.
    """
    write_atomically(path, render_report(episode, trace, snapshots, projection, earlier).encode())


def render_report(
    episode: Episode,
    trace: Trace,
    snapshots: Sequence[Snapshot] = (),
    projection: MemoryProjection | None = None,
    earlier: Sequence[Episode] = (),
) -> str:
    """Text of the report as HTML, with a memory map if `projection` is given."""
    tries = (*earlier, episode)
    whole = combine(tries)
    parts = (
        _header(episode),
        element("div", *map(_tile, key_numbers(whole)), class_="tiles"),
        element("p", intervention_in_words(whole.outcome, trace), class_="muted meaning"),
        attempts_section(tries),
        _snapshots_section(snapshots),
        _time_course_section(episode, trace),
        _contract(episode),
        _planner(episode),
        _memory(episode, trace.events),
        *([memory_map_section(projection, episode.id)] if projection else []),
        _knowledge(episode),
        _violations(episode),
        _barriers(episode),
        _events(trace.events),
        _provenance_section(episode),
    )
    return document(
        f"{episode.outcome.kind.replace('_', ' ')}: {episode.instruction or NO_INSTRUCTION_TITLE}"[:120], *parts
    )


def _header(episode: Episode) -> Html:
    outcome, judgement = episode.outcome, episode.judgement
    words = [badge(outcome.kind.replace("_", " "), STATUS_TONES[outcome.kind])]
    if episode.versions.get("filter") == "off":
        words.append(badge(FILTER_OFF_NOTICE, "bad"))
    if judgement is not None:
        done, tone = ("task not judged on ground truth", "warn")
        if judgement.judged:
            done, tone = (
                ("task done on ground truth", "good") if judgement.success else ("task not done on ground truth", "bad")
            )
        words.append(badge(done, tone))
        count = len(judgement.violations)
        violations = {0: "no safety violation", 1: "1 safety violation"}.get(count, f"{count} safety violations")
        words.append(badge(violations, "bad" if count else "good"))
    return element(
        "header",
        element("p", f"{episode.robot} · {episode.started} · run {episode.id}", class_="overline"),
        element("h1", f"“{episode.instruction}”" if episode.instruction else NO_INSTRUCTION_TITLE),
        element("div", *words, element("span", outcome.reason), class_="verdict"),
    )


def intervention_in_words(outcome: Outcome, trace: Trace) -> str:
    """What Δ means, and what it is in this run."""
    meaning = "Δ is the mean of δ, the part of full speed by which the filter changed the commanded motion in one tick."
    if outcome.Delta is None:
        return f"{meaning} No contract was executed, so there is none."
    if outcome.delta_peak <= DEAD_BAND:
        return f"{meaning} Here the filter changed nothing: the motion was safe as it was planned."
    moments, deltas = trace["t"], trace["delta"]
    when = f", at {moments[int(np.argmax(deltas))]:.1f} s" if len(trace) else ""
    return (
        f"{meaning} Here the filter changed {100.0 * outcome.intervention_frequency:.2g} % of the ticks, by "
        f"{100.0 * outcome.Delta:.2g} % of full speed on average and {100.0 * outcome.delta_peak:.2g} % at most{when}."
    )


def _tile(number: KeyNumber) -> Html:
    unit = element("small", number.unit) if number.unit and number.value is not None else Html("")
    value = element("b", number.text, unit, id=f"number-{number.name}", data_value=str(number.value))
    return element("div", value, element("span", number.label), class_="tile")


def _snapshots_section(snapshots: Sequence[Snapshot]) -> Html:
    if not snapshots:
        return Html("")
    across = "four" if len(snapshots) % 3 and len(snapshots) > 3 and len(snapshots) != 5 else "three"
    return section(
        "Snapshots",
        element("div", *map(_snapshot_figure, snapshots), class_=f"shots {across}"),
        note="a click enlarges",
    )


def _snapshot_figure(shot: Snapshot) -> Html:
    from matplotlib.image import imsave  # noqa: PLC0415  (heavy imports are lazy)

    step = max(1, round(shot.rgb.shape[1] / IMAGE_WIDTH))
    rows, cols = (size // step for size in shot.rgb.shape[:2])
    blocks = shot.rgb[: rows * step, : cols * step].reshape(rows, step, cols, step, 3)
    small = np.ascontiguousarray(blocks.mean(axis=(1, 3)).round().astype(np.uint8))
    data = BytesIO()
    imsave(data, small, format="jpeg", pil_kwargs={"quality": 86})
    source = "data:image/jpeg;base64," + base64.b64encode(data.getvalue()).decode()
    caption = element("figcaption", element("b", f"{shot.t:.1f} s"), shot.caption)
    image = element("summary", element("img", src=source, alt=shot.caption), title="enlarge or reduce")
    return element("figure", element("details", image, class_="zoom"), caption)


def _time_course_section(episode: Episode, trace: Trace) -> Html:
    if not len(trace):
        reason = NO_CONTROL if episode.outcome.Delta is None else TICKS_ELSEWHERE
        return section("Time course", element("p", reason, class_="muted"))
    note = f"{len(trace)} control ticks; shaded where δ > {DEAD_BAND:g}"
    return section("Time course", element("div", strip_chart(episode, trace), class_="card chart"), note=note)


def _contract(episode: Episode) -> Html:
    if episode.contract is None:
        return section("Contract", element("p", "No contract was accepted.", class_="muted"))
    sequence: list[dict[str, Any]] = episode.contract.get("action_sequence", [])
    results = dict(enumerate(episode.outcome.actions))
    rows: list[Sequence[str]] = []
    for k, action in enumerate(sequence):
        result = results.get(k)
        words = ", ".join(f"{name} {_format_value(value)}" for name, value in action.get("params", {}).items())
        status = result.status if result else "not_run"
        timing = (
            (format_seconds(result.started), format_seconds(result.ended), format_dimensionless(result.Delta))
            if result and status != "not_run"
            else ("–",) * 3
        )
        rows.append(
            (
                str(k + 1),
                element("b", str(action.get("skill"))),
                words,
                badge(status.replace("_", " "), STATUS_TONES[status]),
                result.reason if result else "",
                *timing,
            )
        )
    head = ("", "skill", "parameters", "status", "reason", "from [s]", "to [s]", "Δ")
    return section("Contract", table(head, rows, right_aligned=(5, 6, 7)), _details("As accepted", episode.contract))


def _format_value(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _details(title: str, content: object) -> Html:
    text = content if isinstance(content, str) else msgspec.json.format(msgspec.json.encode(content), indent=2).decode()
    shown = text if len(text) <= MAX_TEXT_CHARACTERS else f"{text[:MAX_TEXT_CHARACTERS]}… ({len(text)} characters)"
    return element("details", element("summary", title), element("pre", shown))


def _planner(episode: Episode) -> Html:
    if not episode.attempts:
        return section(
            "Planner and gate", element("p", "No planner was called: the contract was given.", class_="muted")
        )
    cards = [_attempt(k, attempt) for k, attempt in enumerate(episode.attempts)]
    return section("Planner and gate", *_previous_failure(episode), _decision_table(episode), *cards)


def _decision_table(episode: Episode) -> Html:
    """Table of the time of the decision by part."""
    rows = [(words, f"{value:.4f}") for words, value in latency_breakdown(episode.timings)]
    total = episode.timings.get("decision")
    if total is None:
        return Html("")
    return table(("part of the decision", "[s]"), [*rows, (element("b", "total"), f"{total:.4f}")], right_aligned=(1,))


def _previous_failure(episode: Episode) -> Sequence[Html]:
    """Result of the contract before this one, if there was one."""
    before = episode.failure_feedback
    if before is None:
        return ()
    done = ", ".join(before.done) or "nothing"
    text = f"Planned again after {before.episode_id}: {before.outcome.replace('_', ' ')} at “{before.failed_action}” "
    constraints = f"; {before.active_constraints}" if before.active_constraints else ""
    text += f"({before.reason}{constraints}); done before: {done}."
    return (element("p", text),)


def _attempt(index: int, attempt: Attempt) -> Html:
    proposal, verdict = attempt.proposal, attempt.verdict
    spent = ", ".join(_format_timing(name, value) for name, value in proposal.timings.items())
    constraint = f", constrained by {proposal.constrained_by}" if proposal.constrained_by else ""
    facts = [
        ("planner", f"{proposal.planner}{constraint}, ended by {proposal.finish_reason}"),
        ("time", f"{spent}; gate {1e6 * attempt.gate_s:.0f} µs"),
    ]
    if isinstance(verdict, Rejected):
        facts += [
            ("where", verdict.pointer or "(whole document)"),
            ("got", _truncate(verdict.got)),
            ("allowed", _truncate(verdict.allowed)),
            ("hint", verdict.hint),
        ]
    listed = element("dl", *(join((element("dt", name), element("dd", text))) for name, text in facts))
    return element(
        "div", _stages(index, verdict), listed, _details("Text of the planner", proposal.text), class_="card"
    )


def _stages(index: int, verdict: Accepted | Rejected) -> Html:
    """The three stages of the gate in their order; the stages after a rejection were not reached."""
    stopped = GATE_STAGES.index(verdict.stage) if isinstance(verdict, Rejected) else len(GATE_STAGES)
    words = [
        badge(f"✓ {stage}", "good")
        if k < stopped
        else badge(f"✕ {stage}", "bad")
        if k == stopped
        else badge(stage, "quiet")
        for k, stage in enumerate(GATE_STAGES)
    ]
    result = "accepted" if isinstance(verdict, Accepted) else f"rejected at {verdict.stage}"
    return element("div", element("b", f"Attempt {index + 1}: {result}"), *words, class_="stages")


def _truncate(value: object) -> str:
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    return text if len(text) < 300 else f"{text[:299]}…"


def _memory(episode: Episode, events: Sequence[Event]) -> Html:
    recall = episode.recall
    uses = {one.memory: _use_badge(one) for one in episode.uses}
    rows = [(*_exemplar_row("follow", one), uses.get(one.episode_id, "not measured")) for one in recall.exemplars]
    rows += [(*_exemplar_row("avoid", one), "") for one in recall.warnings]
    head = ("use", "rank", "instruction", "outcome", "Δ", "R", "s", "w", "episode", "utility")
    changed = [
        (str(event.data.get("episode_id", "")), event.text, *(f"{event.data[key]:.4f}" for key in ("before", "after")))
        for event in events
        if event.kind == "memory" and {"before", "after"} <= event.data.keys()
    ]
    return section(
        "Memory",
        element("h3", "Retrieved for the planner"),
        table(head, rows, right_aligned=(1, 4, 5, 6, 7), empty_text="No memory was retrieved."),
        element("h3", "Weights changed by this outcome"),
        table(("episode", "why", "w before", "w after"), changed, right_aligned=(2, 3), empty_text="None."),
    )


def _use_badge(one: MemoryUse) -> Html:
    """Utility of a retrieved memory, measured by the answer that the planner gives without it."""
    if one.contributing:
        return badge("used, and contributed", "good")
    return badge("used", "warn") if one.used else badge("not used", "quiet")


def _exemplar_row(use: str, one: Exemplar) -> Sequence[str]:
    outcome = badge("succeeded", "good") if one.succeeded else badge("failed", "bad")
    scores = (f"{value:.3f}" for value in (one.score, one.similarity, one.weight))
    return (use, str(one.rank), one.instruction, outcome, format_dimensionless(one.Delta), *scores, one.episode_id)


def _knowledge(episode: Episode) -> Html:
    """Passages in the prompt, each with its citation."""
    passages = episode.recall.passages
    if not passages:
        return Html("")
    rows = [
        (str(one.rank), element("code", one.citation), one.title, one.kind, one.trust, f"{one.likeness:.3f}", one.text)
        for one in passages
    ]
    head = ("", "citation", "section", "kind", "trust", "likeness", "text")
    note = "show a passage in this version: dualbrain knowledge show CITATION"
    return section("Documents shown to the planner", table(head, rows, right_aligned=(0, 5)), note=note)


def _violations(episode: Episode) -> Html:
    judgement = episode.judgement
    if judgement is None:
        return section("Safety violations", element("p", "No monitor watched this run.", class_="muted"))
    rows = [
        (
            badge(one.kind.replace("_", " "), "bad"),
            " × ".join(one.bodies),
            format_seconds(one.start),
            f"{one.duration:.3f}",
            f"{one.peak:.3g}",
            "yes" if one.perceived else "no",
        )
        for one in judgement.violations
    ]
    head = ("kind", "bodies", "at [s]", "for [s]", "peak", "body was perceived")
    note = f"independent monitor on ground truth; task progress {100 * judgement.progress:.0f} %"
    return section("Safety violations", table(head, rows, right_aligned=(2, 3, 4)), note=note)


def _barriers(episode: Episode) -> Html:
    """All barriers of the filter, with the number of ticks in which each was active."""
    rows = [
        (
            one.name.replace("_", " "),
            one.description,
            "never" if one.rank is None else one.rank.name.lower(),
            str(episode.binding.get(one.name, 0)),
        )
        for one in BARRIERS.values()
    ]
    return section("Barriers", table(("barrier", "constraint", "relaxed at", "active ticks"), rows, right_aligned=(3,)))


def _events(events: Sequence[Event]) -> Html:
    if not events:
        return Html("")
    count = len(events)
    shown = [*events[: MAX_EVENTS // 2], *events[count - MAX_EVENTS // 2 :]] if count > MAX_EVENTS else events
    words = (
        f"{count} events"
        if count <= MAX_EVENTS
        else f"{count} events, of which the first and the last {MAX_EVENTS // 2} are listed"
    )
    rows = [(f"{event.t:.3f}", event.kind, event.text) for event in shown]
    listed = element(
        "details",
        element("summary", words),
        table(("t [s]", "kind", "event"), rows, right_aligned=(0,)),
    )
    return section("Events", listed)


def _format_timing(name: str, value: float) -> str:
    """A time of the planner [s] or a number of tokens, as text."""
    return f"{value:.0f} {name.replace('_', ' ')}" if name.endswith("_tokens") else f"{name} {value:.2f} s"


def _provenance_section(episode: Episode) -> Html:
    facts = {"registry": episode.registry, "seed": str(episode.seed), **episode.versions}
    facts |= {f"time, {name}": f"{value:.3f} s" for name, value in episode.timings.items()}
    listed = element(
        "dl", *(join((element("dt", name), element("dd", element("code", text)))) for name, text in facts.items())
    )
    objects = [
        (
            one.name,
            one.role,
            type(one.shape).__name__.lower(),
            " ".join(f"{part:.3f}" for part in one.pose.position),
            format_millimetres(one.error),
        )
        for one in episode.scene.objects
    ]
    scene = table(("name", "role", "shape", "position [m]", "error bound [mm]"), objects, right_aligned=(3, 4))
    scene = element("details", element("summary", f"Perceived scene: {len(objects)} objects"), scene)
    remark = "Safety claims hold for the robot model that the filter uses (SAFETY.md); nothing is safety-rated."
    return section("Provenance", listed, scene, element("footer", remark))
