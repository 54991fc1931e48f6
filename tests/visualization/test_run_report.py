"""Report of a run: self-contained, escaped, small, and complete for every outcome."""

import html
import re
from html.parser import HTMLParser
from math import nan
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.recording.trace import Event, Trace
from dualbrain.memory.maintenance.projection import MemoryProjection
from dualbrain.records import Attempt, Episode, Outcome, SceneObject
from dualbrain.robots.interface import RobotState
from dualbrain.safety.barriers import BARRIERS
from dualbrain.visualization.html import memory_map
from dualbrain.visualization.html.attempts import combine
from dualbrain.visualization.html.key_numbers import key_numbers
from dualbrain.visualization.html.memory_map import memory_map_section
from dualbrain.visualization.html.page import Html, element, table
from dualbrain.visualization.html.plot_style import image_figure, light_colours
from dualbrain.visualization.html.run_report import (
    FILTER_OFF_NOTICE,
    MAX_EVENTS,
    Snapshot,
    intervention_in_words,
    render_report,
    write_report,
)
from dualbrain.visualization.html.strip_chart import min_max_downsample, strip_chart
from tests.visualization.conftest import FakeFilterResult

HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(1)>\"' & $x^2$ </style>"
EMPTY = Trace(7)
VOID = ("img", "meta", "br")


class _Page(HTMLParser):
    """Tags, attributes and text of a page; checks that elements nest."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(page)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def value(self, name: str) -> str | None:
        """The exact value of a key number."""
        at = self.attributes.index(("id", f"number-{name}"))
        return dict(self.attributes[at : at + 2])["data-value"]


@given(st.text())
def test_plain_text_is_escaped(text: str) -> None:
    page = _Page(element("div", text, element("p", text), title=text))
    assert page.tags == ["div", "p"]
    assert table(("a",), [(text,)]).count("<td") == 1


@given(st.lists(st.floats(-1, 1) | st.just(nan), min_size=1, max_size=300), st.integers(1, 20))
def test_downsampling_keeps_order_ends_extremes_and_gaps(values: list[float], buckets: int) -> None:
    t, y = np.arange(len(values)) * 0.1, np.array(values)
    thin_t, thin_y = min_max_downsample(t, y, buckets)
    assert np.all(np.diff(thin_t) > 0)
    assert len(thin_t) <= 3 * buckets + 2
    assert (thin_t[0], thin_t[-1], np.isnan(thin_y).any()) == (t[0], t[-1], np.isnan(y).any())
    known, thin_known = y[~np.isnan(y)], thin_y[~np.isnan(thin_y)]
    assert (thin_known.min(initial=2.0), thin_known.max(initial=-2.0)) == (
        known.min(initial=2.0),
        known.max(initial=-2.0),
    )


@pytest.fixture(scope="module")
def page(episode: Episode, trace: Trace) -> str:
    """Report of the successful run with three snapshots."""
    image = np.random.default_rng(1).integers(0, 255, (480, 640, 3), np.uint8)
    return render_report(episode, trace, [Snapshot(t, f"at {t}", image) for t in (0.0, 10.6, 20.0)])


def test_the_page_is_self_contained(page: str) -> None:
    parsed = _Page(page)
    assert not {"script", "link", "iframe", "object", "form"} & set(parsed.tags)
    assert ("http-equiv", "Content-Security-Policy") in parsed.attributes
    assert any((value or "").startswith("default-src 'none'; img-src data:;") for _, value in parsed.attributes)
    for name, value in parsed.attributes:
        assert not name.startswith("on")
        if name in ("src", "href", "xlink:href"):
            assert (value or "").startswith(("data:image/jpeg;base64,", "#"))
    assert not re.search(r"url\((?!#)|@import", page)
    assert len(page) < 3e6
    assert "prefers-color-scheme: dark" in page
    assert "#0101" not in page


def test_the_report_shows_the_numbers_of_the_episode(page: str, episode: Episode) -> None:
    parsed = _Page(page)
    assert float(parsed.value("Delta") or "nan") == episode.outcome.Delta
    assert float(parsed.value("h_min") or "nan") == episode.outcome.h_min
    assert float(parsed.value("intervention_frequency") or "nan") == episode.outcome.intervention_frequency
    assert f"{1e3 * (episode.outcome.h_min or 0):.2f} mm at" in page
    for part in (
        "choose a speed of at most 0.4 m/s",
        "/action_sequence/0/params/speed",
        "0.5873",
        "9f3c2ab1",
        "e-0029",
    ):
        assert part in parsed.text


def test_every_barrier_is_listed_with_its_active_ticks(episode: Episode, trace: Trace) -> None:
    bound = msgspec.structs.replace(episode, binding={"workspace": 123})
    page = render_report(bound, trace)
    assert all(html.escape(one.description) in page for one in BARRIERS.values())
    assert ">123<" in page


def test_hostile_text_is_escaped(episode: Episode, trace: Trace) -> None:
    shot = episode.attempts[0]
    proposal = msgspec.structs.replace(shot.proposal, text=HOSTILE, planner=HOSTILE)
    verdict = msgspec.structs.replace(shot.verdict, got=HOSTILE, hint=HOSTILE, pointer=HOSTILE)
    evil = msgspec.structs.replace(
        episode,
        instruction=HOSTILE,
        attempts=(Attempt(proposal, verdict, 0.0),),
        contract={"action_sequence": [{"skill": HOSTILE, "params": {"object": HOSTILE, HOSTILE: HOSTILE}}]},
        scene=msgspec.structs.replace(episode.scene, objects=tuple(_renamed(one) for one in episode.scene.objects[:2])),
        versions={HOSTILE: HOSTILE},
    )
    parsed = _Page(render_report(evil, trace, [Snapshot(0.0, HOSTILE, np.zeros((4, 6, 3), np.uint8))]))
    assert "script" not in parsed.tags
    assert parsed.tags.count("img") == 1
    assert not any(name == "onerror" for name, _ in parsed.attributes)
    assert parsed.text.count(HOSTILE) > 8


def _renamed(scene_object: SceneObject) -> SceneObject:
    return msgspec.structs.replace(scene_object, name=HOSTILE)


def test_passages_in_the_prompt_are_shown_with_their_citation(episode: Episode, trace: Trace) -> None:
    page = _Page(render_report(episode, trace))
    for one in episode.recall.passages:
        assert one.citation in page.text
        assert one.text in page.text
    without = msgspec.structs.replace(episode, recall=msgspec.structs.replace(episode.recall, passages=()))
    assert "Documents shown" not in render_report(without, trace)


def test_a_rejected_contract_has_no_plot(rejected: Episode) -> None:
    page = render_report(rejected, EMPTY)
    parsed = _Page(page)
    assert "No control was executed" in parsed.text
    assert "No contract was accepted" in parsed.text
    assert "svg" not in parsed.tags
    assert parsed.value("Delta") == "None"
    assert "rejected at envelope" in parsed.text


def test_a_motion_whose_ticks_are_elsewhere_is_not_called_none(episode: Episode) -> None:
    text = _Page(render_report(episode, EMPTY)).text
    assert "the gatekeeper records them" in text
    assert "No control was executed" not in text


def test_a_run_that_was_taken_over_is_reported(taken_over: Episode, trace: Trace) -> None:
    short = Trace(7)
    short.extend(trace.rows[:4000])
    short.phases[:] = trace.phases
    parsed = _Page(render_report(taken_over, short))
    for part in ("taken over", "no progress for 1.5 s", "1 safety violation", "link5 × forearm", "not run", "12.7"):
        assert part in parsed.text


@pytest.mark.parametrize("ticks", [1, 2])
def test_runs_of_one_or_two_ticks_are_plotted(episode: Episode, ticks: int) -> None:
    from tests.control.recording.sample_ticks import append_ticks  # noqa: PLC0415

    trace = Trace(7)
    append_ticks(trace, ticks, special_values=True)
    stopped = msgspec.structs.replace(
        episode,
        outcome=Outcome(
            kind="stopped",
            reason="stale state",
            Delta=2.0,
            Delta_sum=2.0,
            delta_peak=2.0,
            intervention_frequency=1.0,
            h_min=-np.inf,
        ),
    )
    assert "svg" in _Page(render_report(stopped, trace)).tags


def test_the_file_contains_the_rendered_report(tmp_path: Path, rejected: Episode) -> None:
    write_report(tmp_path / "report.html", rejected, EMPTY)
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == render_report(rejected, EMPTY)


def test_numbers_that_were_not_measured_are_dashes(rejected: Episode, episode: Episode) -> None:
    assert {one.text for one in key_numbers(rejected) if one.name in ("Delta", "h_min", "intervention_frequency")} == {
        "–"
    }
    assert all(isinstance(one.value, float | int) for one in key_numbers(episode))
    assert isinstance(element("p"), Html)


def test_a_report_states_that_not_all_events_are_listed(episode: Episode) -> None:
    """It named the number of all events, listed the first 400, and left out the end of a long run without a word."""
    trace = Trace(7)
    for k in range(MAX_EVENTS + 100):
        trace.events.append(Event(0.1 * k, "phase", f"event number {k}"))
    page = render_report(episode, trace)
    assert f"{MAX_EVENTS + 100} events, of which the first and the last {MAX_EVENTS // 2} are listed" in page
    assert page.count("event number ") == MAX_EVENTS
    assert f"event number {MAX_EVENTS + 99}<" in page
    del trace.events[MAX_EVENTS:]
    assert f"{MAX_EVENTS} events<" in render_report(episode, trace)


def test_the_memory_map_states_that_only_the_newest_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_map, "MAX_POINTS", 3)
    drawn = MemoryProjection(
        points=np.random.default_rng(0).standard_normal((5, 2)),
        weights=np.full(5, 0.5),
        episode_ids=tuple("abcde"),
        kinds=("succeeded",) * 5,
        statuses=("active",) * 5,
        explained_variance=0.61,
    )
    assert "the newest 3 of 5 memories;" in memory_map_section(drawn, "e")


def test_the_memory_map_needs_three_memories():
    points = np.random.default_rng(0).standard_normal((5, 2))
    kinds, statuses = ("succeeded", "failed", "rejected", "succeeded", "failed"), ("active",) * 4 + ("quarantined",)
    drawn = MemoryProjection(
        points=points,
        weights=np.array([0.1, 0.3, 0.5, 0.7, 0.95]),
        episode_ids=tuple("abcde"),
        kinds=kinds,
        statuses=statuses,
        explained_variance=0.61,
    )
    page = memory_map_section(drawn, "c")
    assert page.count("<svg") == 1
    assert "5 memories" in page
    assert "61%" in page
    few = MemoryProjection(
        points=points[:2],
        weights=np.ones(2),
        episode_ids=("a", "b"),
        kinds=kinds[:2],
        statuses=statuses[:2],
        explained_variance=1.0,
    )
    assert "Too few memories" in memory_map_section(few, "a")


@pytest.mark.parametrize(
    ("n", "width", "expected"),
    [
        (2, 3, ("Driving", "m/s, forward", "Turning", "rad/s, to the left")),
        (9, 10, ("Driving", "m/s, forward", "Turning", "Joint speed")),
        (6, 6, ("Joint speed", "rad/s, Euclidean norm")),
    ],
)
def test_each_robot_has_its_speed_strips_with_units(
    n: int, width: int, expected: tuple[str, ...], episode: Episode
) -> None:
    run = Trace(n, width)
    for k in range(20):
        u = np.full(n, -0.1 * k)
        run.append(
            k * 0.02,
            RobotState(stamp=k * 0.02, sequence=k, q=np.zeros(width), v=u, opening=0.0, finger_forces=(0.0, 0.0)),
            u,
            FakeFilterResult(u, 0, 0.0, 0.0, 0.0, 0.3),
            action=0,
            phase="drive",
        )
    drawn = html.unescape(str(strip_chart(episode, run)))
    assert [word for word in ("Driving", "Turning", "Joint speed") if word in drawn] == [
        word for word in expected if word[0].isupper()
    ]
    assert all(word in drawn for word in expected)


def test_a_run_without_instruction_is_titled_by_its_contract(episode: Episode, trace: Trace) -> None:
    page = _Page(render_report(msgspec.structs.replace(episode, instruction=""), trace, ()))
    assert "a given contract" in page.text
    assert "“”" not in page.text


def test_a_run_without_filter_is_marked_at_the_top(episode: Episode, trace: Trace) -> None:
    unfiltered = msgspec.structs.replace(episode, versions={**episode.versions, "filter": "off"})
    header = render_report(unfiltered, trace).partition("</header>")[0]
    assert FILTER_OFF_NOTICE in header
    assert FILTER_OFF_NOTICE not in render_report(episode, trace)


# --- the meaning of Δ, tries and images -----------------------------------------------------------------------------


def test_the_report_states_the_meaning_of_the_intervention(episode: Episode, trace: Trace) -> None:
    outcome = msgspec.structs.replace(episode.outcome, Delta=0.0021, delta_peak=0.17, intervention_frequency=0.04)
    words = intervention_in_words(outcome, trace)
    assert "0.21 % of full speed on average and 17 % at most" in words
    assert f"at {trace['t'][int(np.argmax(trace['delta']))]:.1f} s" in words
    calm = msgspec.structs.replace(outcome, Delta=0.0, delta_peak=0.0)
    assert "changed nothing" in intervention_in_words(calm, trace)
    assert "No contract was executed" in intervention_in_words(msgspec.structs.replace(outcome, Delta=None), trace)


def test_the_numbers_cover_every_try(episode: Episode, rejected: Episode, trace: Trace) -> None:
    def part(**values: float) -> Episode:
        return msgspec.structs.replace(episode, outcome=msgspec.structs.replace(episode.outcome, **values))

    slow = part(Delta=0.4, delta_peak=0.5, intervention_frequency=0.2, h_min=-0.001, duration=30.0)
    calm = part(Delta=0.0, delta_peak=0.1, intervention_frequency=0.0, h_min=0.02, duration=10.0)
    whole = combine((slow, calm, rejected)).outcome
    assert (whole.Delta, whole.intervention_frequency) == pytest.approx((0.3, 0.15))
    assert (whole.delta_peak, whole.h_min, whole.duration) == (0.5, -0.001, 40.0)
    assert whole.kind == rejected.outcome.kind
    assert combine((calm,)) is calm
    assert combine((rejected, rejected)).outcome.Delta is None
    page = render_report(calm, trace, earlier=(slow,))
    assert page.count("Tries") == 1
    assert 'data-value="40.0"' in page
    assert "Tries" not in render_report(calm, trace)


def test_an_image_is_enlarged_by_a_click_without_a_script(episode: Episode, trace: Trace) -> None:
    page = render_report(episode, trace, [Snapshot(1.0, "descending", np.zeros((720, 960, 3), np.uint8))])
    assert page.count('<details class="zoom"><summary') == 1
    assert "<script" not in page


def test_image_files_use_the_light_colours_of_the_page(tmp_path: Path) -> None:
    from matplotlib.image import imread  # noqa: PLC0415

    with image_figure(tmp_path / "new" / "a.png", 2.0) as figure:
        figure.subplots().bar([0, 1], [1, 2])
    pixels = {tuple(one) for one in (255 * imread(tmp_path / "new" / "a.png")[..., :3]).astype(int).reshape(-1, 3)}
    assert tuple(bytes.fromhex(light_colours()["blue"][1:])) in pixels
    assert set(light_colours()) >= {"text", "muted", "blue", "red", "green"}
