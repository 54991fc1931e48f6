"""Report of sample results: tables, captions, charts, and pages that work offline."""

import re
from itertools import pairwise
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
from markdown_it import MarkdownIt

from dualbrain.cli.evaluation.results import last_run_date, load_results
from dualbrain.cli.main import run_command_line
from dualbrain.evaluation.analysis.failure_taxonomy import failure_class_of
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import Estimate
from dualbrain.evaluation.planners.adversary import Adversary
from dualbrain.evaluation.planners.answer_cache import AnswerCache, CachedAnswer
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import load_suite
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.report.all_tables import all_tables
from dualbrain.evaluation.report.captions import VIOLATION_LABELS, caption, headline, truncate
from dualbrain.evaluation.report.decision_latency import decision_latency_table, unbatched_latencies
from dualbrain.evaluation.report.example_selection import select_examples
from dualbrain.evaluation.report.margins_table import margins_table
from dualbrain.evaluation.report.method_contrasts import contrasts_table, method_pairs
from dualbrain.evaluation.report.not_measured import list_not_measured
from dualbrain.evaluation.report.summary import summary_sentence
from dualbrain.evaluation.report.tables import (
    Table,
    failures_table,
    families_table,
    format_estimate,
    format_number,
    markdown_table,
    methods_of,
    overview_table,
    throughput_table,
    violations_table,
)
from dualbrain.evaluation.results.parquet import RESULTS_FILE, write_results
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_BY
from dualbrain.planner.protocol import STOP
from dualbrain.records import Proposal
from dualbrain.simulation.monitoring.safety_monitor import PEAK_UNITS
from dualbrain.visualization.evaluation.charts import (
    MAX_GROUP,
    group_identical,
    group_methods,
    latencies_chart,
    line_style,
    metrics_chart,
    summary_chart,
    traces_chart,
)
from dualbrain.visualization.evaluation.html_report import (
    FailureImage,
    ReportData,
    provenance_facts,
    render_html_report,
)
from dualbrain.visualization.evaluation.markdown_page import write_markdown_page
from tests.evaluation.sample_rows import BYSTANDER_MOVED, COLLISION, TOOL_SPEED, episode_row
from tests.planner.sample_requests import plan_request

FALSE_SUCCESS = {"success": False}
"""The robot reports success, but the ground truth disagrees: failure class `false success`."""
ANSWERS = [
    CachedAnswer(
        "it", "q", Proposal(text="{}", finish_reason=STOP, planner="it", constrained_by="", timings={"total": total})
    )
    for total in (0.5, 2.0)
]


def test_the_overview_lists_every_method_with_its_numbers(rows):
    table = overview_table(rows)
    assert table.header == ("metric", "B1", "B3", "M")
    lines = {line[0]: line[1:] for line in table.rows}
    assert lines["violation rate"][0].startswith("50.0 %")
    assert lines["violation rate"][1].startswith("0.0 %")
    assert lines["Δ of successes"][0] == "–"
    assert lines["episodes (clusters)"] == ("4 (2)",) * 3


def test_a_wide_table_is_split_into_parts_with_row_names():
    header = ("metric", *(f"m{k}" for k in range(20)))
    table = Table("t", header, (("success", *map(str, range(20))), ("Δ", *map(str, range(100, 120)))))
    first, second = table.split_columns()
    assert first[0] == ("metric", *header[1:11])
    assert second[0] == ("metric", *header[11:])
    assert [row[0] for row in second[1]] == ["success", "Δ"]
    assert [left + right[1:] for left, right in zip(first[1], second[1], strict=True)] == list(table.rows)
    assert markdown_table(table).count("| metric | " + " | ".join(header[11:]) + " |") == 1
    narrow = Table("t", header[:12], (tuple(map(str, range(12))),))
    assert narrow.split_columns() == [(narrow.header, list(narrow.rows))]


def test_many_methods_are_drawn_in_panels_with_their_variants():
    assert group_methods(("B1", "B3", "M", "M-half")) == [["B1", "B3", "M", "M-half"]]
    methods = methods_of([episode_row(name, seed=1, repetition=0) for name in load_suite("ablations").methods])
    found = group_methods(methods)
    assert found[0] == ["B4", "M", "M-success", "M-half", "M-double"]
    assert sorted(name for group in found for name in group) == sorted(methods)
    assert max(map(len, found)) <= MAX_GROUP


def test_numbers_are_formatted_for_people():
    assert [format_number(value, "share") for value in (0.123, float("nan"))] == ["12.3 %", "–"]
    assert format_number(-0.0012345) == "−0.00123"
    assert (
        format_estimate(Estimate(mean=0.5, sd=0.1, low=0.4, high=0.6, n=10, clusters=5), "1") == "0.5 ± 0.1 [0.4, 0.6]"
    )
    assert format_estimate(Estimate(mean=0.5, sd=0.5, low=-np.inf, high=np.inf, n=10, clusters=1), "1") == "0.5 ± 0.5"


def test_rounding_errors_are_printed_as_zero():
    assert [format_number(value) for value in (1.41e-17, -3e-16, 2.07e-7)] == ["0", "0", "2.07e−07"]


def test_the_gate_time_is_given_in_milliseconds_of_a_shared_processor(rows):
    table = overview_table(rows)
    (line,) = (line for line in table.rows if line[0].startswith("gate time"))
    assert line[0] == "gate time [ms]"
    assert line[1].startswith("0.1 ")  # 1e-4 s
    assert "shares its processor" in table.note


def test_an_impossible_violation_is_a_dash_not_a_share():
    constrained, free = ({"constrained_by": by} for by in ("llguidance 1.9.1", f"{UNCONSTRAINED_BY}; header given"))
    attack = {"constrained_by": Adversary().propose(plan_request()).constrained_by}
    rows = [episode_row("B1", **constrained), episode_row("B3", **free), episode_row("A1"), episode_row("A3", **attack)]
    lines = {line[0]: line for line in violations_table(rows).rows}
    cells = lines["unauthorised skill"]
    assert cells[1] == "–"
    assert [cell.split()[0] for cell in cells[2:]] == ["0.0"] * 3  # no grammar constrained them
    assert lines["collision with a person"][1].startswith("0.0 %")
    assert violations_table([episode_row("B1", **constrained)]).note.endswith("no unauthorised skill could be called")
    mixed = [episode_row("B1", **constrained), episode_row("B1", 1, **free)]
    assert {line[0]: line for line in violations_table(mixed).rows}["unauthorised skill"][1].startswith("0.0 %")
    assert "grammar" not in violations_table(mixed).note


def test_every_kind_of_violation_has_a_label():
    assert VIOLATION_LABELS.keys() == PEAK_UNITS.keys()


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"violations": (TOOL_SPEED,)}, "succeeded, with a violation: tool speed"),
        (
            {"violations": (BYSTANDER_MOVED, COLLISION)},
            "succeeded but unsafe: other object moved, collision with the environment",
        ),
        ({"success": False, "violations": (TOOL_SPEED,)}, "drive"),
    ],
)
def test_the_headline_of_an_image_names_the_failure_or_the_violations(values, expected):
    """A success is unsafe exactly if the metric counts it as unsafe."""
    row = episode_row(**values)
    assert headline(row) == expected
    unsafe = METRIC_BY_NAME["succeeded but unsafe"].value_of(row)
    assert expected.startswith("succeeded but unsafe") == bool(unsafe)


def test_a_caption_is_cut_at_the_end_of_a_word():
    done = {"success": False, "reason": "above clear_glass", "task": "t", "seed": 7}
    assert caption(episode_row(**done), COLLISION) == "Collision with the environment, hand × cup, at 1.0 s (t, seed 7)"
    assert caption(episode_row(**done, meant=False), None) == (
        "The robot executed the contract, “above clear_glass”, but the contract is not about the instruction"
        " (t, seed 7)"
    )
    assert caption(episode_row(**done), None).startswith(
        "The robot reports success, “above clear_glass”; the ground truth disagrees"
    )
    ended = {"claimed": False, "outcome": "taken_over", "reason": "no safe control: " + "full speed " * 20}
    cut = caption(episode_row(**done | ended), None)
    assert cut.startswith("The safety layer ended the contract: no safe control: full speed")
    assert re.search(r"(full|speed) … \(t, seed 7\)$", cut)
    assert truncate("one two three", 7) == "one two …"
    assert truncate("one two three", 13) == "one two three"


def test_a_report_states_its_provenance_as_far_as_it_was_recorded(suite, tmp_path):
    known = {
        "origin": {"code": "abc", "machine": "Linux x86_64", "numpy": "2.4.6", "torch": "2.13"},
        "host": {"processor": "Sparrow 3", "cores": "2", "memory": "3.8 GiB", "revision": "deadbeef-dirty"},
    }
    rows = [
        episode_row("M", epsilon=0.00207),
        episode_row("M-half", epsilon=0.001),
        episode_row("Full", epsilon=0.00207),
        episode_row("B3"),
    ]
    data = ReportData(rows=rows, suite=suite, config=known, command="again")
    found = provenance_facts(data)
    assert found["machine"] == "Linux x86_64, Sparrow 3, 3.8 GiB, 2 cores"
    assert found["packages"] == "numpy 2.4.6, torch 2.13"
    assert found["ε"] == "0.00207 on panda (M, Full); 0.001 on panda (M-half)"
    write_markdown_page(tmp_path, data)
    for page in (render_html_report(data), (tmp_path / "report.md").read_text().replace("\\", "")):
        for part in ("deadbeef-dirty", "Sparrow 3", "torch 2.13", "0.00207 on panda"):
            assert part in page
    older = provenance_facts(ReportData(rows=[episode_row("B3")], suite=suite, config={}))
    assert (older["revision"], older["machine"], older["packages"]) == ("not recorded",) * 3
    assert "ε" not in older


def test_a_report_on_older_results_shows_no_password_of_a_planner(suite):
    named = msgspec.structs.replace(suite, planners={"base": "https://user:pa55word@host/v1#m"})
    found = provenance_facts(ReportData(rows=[episode_row("B3")], suite=named, config={}))
    assert found["planners"] == "base: https://host/v1#m"


def test_line_styles_differ_and_neighbours_differ_in_colour_and_dash():
    styles = [line_style(k) for k in range(MAX_GROUP)]
    assert all(a != b for k, a in enumerate(styles) for b in styles[k + 1 :])
    pairs = list(pairwise(styles))
    assert all(a["color"] != b["color"] and a["linestyle"] != b["linestyle"] for a, b in pairs)


def test_every_method_has_its_own_panels_and_its_own_bars():
    rows = [episode_row(name, seed=seed) for name in load_suite("ablations").methods for seed in (1, 2)]
    methods = methods_of(rows)
    curves, bars = metrics_chart(rows), summary_chart(rows)
    for name in methods:
        assert curves.count(f">{name}<") == 1
        assert bars.count(f">{name}<") == 1
    assert bars.count(" %<") >= 2 * len(methods)


def test_the_first_sentence_counts_violations_with_and_without_the_filter():
    rows = [episode_row("B3", seed=seed) for seed in range(4)]
    rows += [episode_row("B1", seed=seed, violations=(COLLISION,) * (seed < 3)) for seed in range(4)]
    sentence = summary_sentence(rows)
    kinds = "had a collision, an exceeded joint limit or an unauthorised call"
    assert sentence.startswith(f"With the safety filter (B3) 0 of 4 episodes {kinds} (0.0 %")
    assert f"; without it (B1) 3 of 4 episodes {kinds} (75.0 %" in sentence
    assert "Violations of any kind" in sentence
    assert summary_sentence(rows[4:]).startswith("Without the safety filter (B1) 3 of 4")
    assert "without" not in summary_sentence(rows[:4])
    assert summary_sentence([]) == "No episode was run."


def test_identical_methods_share_a_line_and_each_violation_is_marked():
    same, with_violations = episode_row("B1"), episode_row("M", violations=(COLLISION, BYSTANDER_MOVED))
    here = {"B1": same, "B2": episode_row("B2"), "B3": episode_row("B3", trace_h=[0.02, 0.005]), "M": with_violations}
    assert group_identical(here, ("B1", "B2", "G", "B3", "M")) == [["B1", "B2"], ["B3"], ["M"]]
    chart = traces_chart(list(here.values()))
    assert ">B1 = B2<" in chart
    assert chart.count(">time [s]<") == 2  # under each panel
    marks = re.findall(r'<use [^>]*xlink:href="#(m[0-9a-f]+)"', chart)
    without = re.findall(r'<use [^>]*xlink:href="#(m[0-9a-f]+)"', traces_chart([*here.values()][:3]))
    assert len(marks) >= len(without) + 2
    assert "no traces in this table" in traces_chart([episode_row("B1", trace_t=[], trace_h=[], trace_delta=[])])


def test_axes_of_latencies_are_labelled(rows):
    chart = latencies_chart(rows, [0.5, 2.0])
    for words in ("share of measurements below", "time [s]", "time [ms]", "time [µs]"):
        assert f">{words}<" in chart


def test_families_are_listed_as_a_whole_and_by_level():
    two = [
        episode_row("B3", run, seed=run, task=f"edge_rescue {level}", success=level == "I")
        for level in ("I", "II")
        for run in range(3)
    ]
    lines = {line[0]: line[1] for line in families_table(two).rows}
    shares = [lines[f"panda edge_rescue{part}: success"].split("%")[0] for part in ("", " I", " II")]
    assert shares == ["50.0 ", "100.0 ", "0.0 "]
    assert "panda edge_rescue: success" not in {line[0] for line in families_table(two[:3]).rows}


def test_only_declared_pairs_of_methods_are_compared():
    switches = {(a, b): switch for switch, a, b in method_pairs(tuple(METHODS))}
    assert switches["G", "B3"] == "guard"
    assert switches["B4", "M"] == switches["P", "Full"] == switches["Full", "Full-static"] == "memory"
    assert switches["PE", "P"] == switches["M", "Full"] == switches["P", "P-no-kl"] == "asks"
    assert switches["Full", "Full-success"] == "asks, signal"
    assert switches["A1", "A3"] == "door, guard"
    assert {b for _, b in switches} == set(METHODS) - {"B1", "A1"}  # every method has one that it is derived from
    assert ("B1", "B3") not in switches
    assert ("P-no-kl", "P-all") not in switches
    assert not list(method_pairs(("B3", "P-all")))
    rows = [
        episode_row(name, run, seed=run, success=name == "B3", guarded=name == "B3")
        for name in ("G", "B3")
        for run in range(9)
    ]
    lines = {line[2]: line for line in contrasts_table(rows).rows}
    assert lines["success"][:2] + lines["success"][3:5] == ("guard", "B3 − G", "100.0 %", "[100.0 %, 100.0 %]")
    assert float(lines["success"][5]) < 0.05
    assert "Δ of successes" not in lines  # a method without filter has none


def test_identical_comparisons_do_not_enlarge_the_correction():
    rows = [
        episode_row(name, run, seed=run, success=name == "B3" or run > 5) for name in ("G", "B3") for run in range(12)
    ]
    lines = {line[2]: line for line in contrasts_table(rows).rows}
    assert lines["violation rate"][5] == "–"
    assert lines["success"][5] == format_number(2 / 2**6)


def test_failures_add_up(rows):
    lines = {line[0]: line[1:] for line in failures_table(rows).rows}
    assert lines["collision"] == lines["all failures"] == ("2", "0", "0")


def test_failures_are_classified_by_the_current_rule_not_by_the_stored_class(rows):
    before = [msgspec.structs.replace(one, failure="drive") if one.failure else one for one in rows]
    assert failures_table(before) == failures_table(rows)
    assert [one.key for one in select_examples(before, 9)] == [one.key for one in select_examples(rows, 9)]


def test_wall_time_shares_add_up_and_one_suspended_episode_does_not_change_the_throughput():
    """In older tables the parts overlap, and their sum exceeds the whole."""
    wall = {"physics": 3.0, "monitor": 1.0, "filter": 0.5, "planner": 1.5, "rest": 0.0}
    episodes = [episode_row("B3", seed=seed, wall_s=2.0, wall=wall, simulated_s=12.0) for seed in range(9)]
    (line,) = throughput_table(episodes).rows
    assert line[1:3] == ("600", "2.00")
    assert sum(float(share.removesuffix(" %")) for share in line[3:]) == pytest.approx(100.0, abs=0.2)
    stalled = episode_row("B3", seed=9, wall_s=925.0, wall=wall | {"physics": 922.0}, simulated_s=12.0)
    assert throughput_table([*episodes, stalled]).rows[0][1:3] == ("600", "2.00")
    assert (
        float(throughput_table([*episodes, stalled]).rows[0][3].removesuffix(" %")) < 56.0
    )  # one tenth of the episodes
    assert "median" in throughput_table(episodes).note


def test_a_report_lists_what_was_not_measured(rows, suite):
    text = " ".join(list_not_measured(rows, suite))
    for part in ("on a real robot", "Full (", "H2", "retrieval utility", "language model", "hazardous", "100 episodes"):
        assert part in text
    cost = AdapterCost(id="1", base="base", samples=100, steps=60, size=5, bootstrapped=True)
    assert any("other planners also proposed" in one for one in list_not_measured(rows, suite, {"adapted": cost}))
    assert not any("other planners also proposed" in one for one in list_not_measured(rows, suite, {"base": cost}))


def test_examples_cover_as_many_classes_and_methods_as_possible():
    some = [
        episode_row(method, k, key=f"{method}{k}", **FALSE_SUCCESS | values)
        for k, (method, values) in enumerate(
            [("B1", {}), *2 * [("B1", {"perceived_error": 1.0})], ("B1", {"outcome": "taken_over", "claimed": False})]
        )
    ]
    assert {failure_class_of(one) for one in select_examples(some, 3)} == {
        "false success",
        "perception",
        "motion blocked",
    }
    assert select_examples([*some, episode_row("B2", key="idle", **FALSE_SUCCESS, trace_t=[])], 9) != []
    assert "idle" not in [
        one.key for one in select_examples([episode_row("B2", key="idle", **FALSE_SUCCESS, trace_t=[])], 9)
    ]


def test_examples_contain_a_shared_episode_once_and_other_scenes_first():
    first = episode_row("B1", key="first", **FALSE_SUCCESS, severity=0.9)
    shared = episode_row("B2", key="shared", **FALSE_SUCCESS, severity=0.9, same_as="first")
    again = episode_row("G", repetition=1, key="again", **FALSE_SUCCESS, severity=0.8)
    elsewhere = episode_row("B1", seed=7, key="elsewhere", **FALSE_SUCCESS, severity=0.1)
    assert [one.key for one in select_examples([first, shared, again, elsewhere], 9)] == ["first", "elsewhere", "again"]


def test_the_html_report_is_one_file_without_script_and_escapes_its_texts(rows, suite):
    evil = episode_row("M", 1, seed=9, instruction="<script>alert(1)</script>", planner="<b>template</b>")
    shots = [FailureImage(rows[1], "<img src=x>", np.zeros((48, 64, 3), np.uint8))]
    page = render_html_report(
        ReportData(
            rows=[*rows, evil],
            suite=suite,
            config={"origin": {"code": "abc"}},
            cached_answers=ANSWERS,
            gallery=shots,
            date="2026-11-21",
        )
    )
    assert "<script" not in page
    assert "<b>template" not in page
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page)
    for part in (
        "missed deadline",
        "H1",
        "Methods and metrics",
        "Metrics over repetitions",
        "Latency",
        "Not measured",
        "&lt;img src=x",
    ):
        assert part in page
    assert page.count("<svg") == 4
    assert page.index("With the safety filter") < page.index("<svg") < page.index("<table")


def test_the_markdown_page_shows_images_of_its_folder_and_escapes_its_texts(rows, suite, tmp_path):
    shots = [FailureImage(rows[1], "<img src=x> [a](b) `c`", np.zeros((48, 64, 3), np.uint8))]
    for left_over in ("failure_1.jpg", "failure_2.jpg", "failure_cam.jpg", "failure_7.jpg"):
        (tmp_path / left_over).write_bytes(b"image of a larger gallery")
    (tmp_path / "report.md").write_text("![1](failure_1.jpg)\n![2](failure_2.jpg)\n")
    write_markdown_page(
        tmp_path,
        ReportData(
            rows=rows,
            suite=suite,
            config={"origin": {"code": "abc"}},
            cached_answers=ANSWERS,
            gallery=shots,
            date="2026-11-21",
            command="again",
        ),
    )
    page = (tmp_path / "report.md").read_text()
    for part in (
        "## Hypotheses",
        "12 episodes, 2026-11-21, code abc, seeds 0 to 1 (2)",
        "Reproduce: `again`",
        "not measured",
        "none of them is a missed deadline",
        "docs/reference/safety/kernel.md",
        "## Provenance",
    ):
        assert part in page
    assert r"&lt;img src=x\> [a\](b) \`c\`" in page
    shown = re.findall(r"!\[.*?\]\(([a-z_0-9.]+)\)", page)
    assert shown == ["summary.svg", "curves.svg", "traces.svg", "latencies.svg", "failure_1.jpg"]
    for name in shown:
        assert (tmp_path / name).stat().st_size > 300
    assert not (tmp_path / "failure_2.jpg").exists()
    assert (tmp_path / "failure_cam.jpg").exists()  # not an image of the replaced page
    assert (tmp_path / "failure_7.jpg").exists()
    chart = (tmp_path / "curves.svg").read_text()
    assert "mathdefault" not in (tmp_path / "latencies.svg").read_text()  # tick labels are numbers, not formulas
    assert ElementTree.fromstring(chart).tag.endswith("svg")
    assert set(re.findall(r"var\((--[a-z]+)\)", chart)) <= set(re.findall(r"(--[a-z]+):", chart))


def test_backslash_and_pipe_of_a_cell_are_both_escaped():
    """GitHub ends a cell at a pipe behind an escaped backslash; other parsers do not."""
    assert markdown_table(Table("t", ("a", "b"), ((r"c\|d", "e"),)))[4] == r"| c\\\|d | e |"


def structure(page):
    """Types of all Markdown tokens, without their text."""
    tokens = MarkdownIt("commonmark").enable("table").parse(page)
    inline = [child.type for token in tokens for child in token.children or () if child.type != "text"]
    return [token.type for token in tokens], inline


@pytest.mark.parametrize(
    "text", ["![x](http://evil/p.png) <img src=x>", r"c\|d", "a|b", "`a` ``` b", "- x\n\n# y", "<!-- &lt; [a]: b"]
)
def test_no_text_of_results_changes_the_form_of_the_markdown_page(suite, tmp_path, text):
    """Results of another person name robots, kinds of violations, planners and keys freely."""

    def page(text):
        moved = msgspec.structs.replace(COLLISION, kind=text, bodies=(text, "cup"))
        changed = {"robot": text, "planner": text, "key": text, "violations": (moved,), "epsilon": 0.1}
        rows = [episode_row("B3", seed=seed, **changed) for seed in (1, 2)]
        named = {"name": text, "description": text, "planners": {"base": text}}
        data = ReportData(
            rows=rows,
            suite=msgspec.structs.replace(suite, **named),
            config={"origin": {"code": text, "numpy": text}},
            gallery=[FailureImage(rows[0], text, np.zeros((48, 64, 3), np.uint8))],
            date=text,
            command=text,
            omissions=[text],
        )
        write_markdown_page(tmp_path, data)
        return (tmp_path / "report.md").read_text()

    assert structure(page(text)) == structure(page("a"))


def test_a_page_in_another_folder_comes_with_the_table_of_all_episodes(rows, suite, tmp_path):
    folder, page = tmp_path / "run", tmp_path / "page"
    folder.mkdir()
    write_results(rows, {"suite": msgspec.to_builtins(suite), "methods": {}, "origin": {}}, folder / RESULTS_FILE)
    whole = (folder / RESULTS_FILE).read_bytes()
    for place in (page, folder):
        assert run_command_line(["report", str(folder), "--gallery", "0", "--page", str(place)]) == 0
    assert (folder / RESULTS_FILE).read_bytes() == whole  # with its traces
    copied, config, _ = load_results(page)
    assert copied == [
        msgspec.structs.replace(one, trace_t=[], trace_h=[], trace_delta=[]) for one in load_results(folder)[0]
    ]
    assert config["flown"] == last_run_date(folder, {})
    modes = [(page / name).stat().st_mode for name in (RESULTS_FILE, "report.md")]
    assert modes[0] == modes[1]  # readers of the page can read the table
    assert run_command_line(["report", str(page), "--page", str(page)]) == 0


def test_a_page_from_a_table_without_traces_keeps_its_images_and_lists_what_is_missing(rows, suite, tmp_path, capsys):
    bare = [msgspec.structs.replace(one, trace_t=[], trace_h=[], trace_delta=[]) for one in rows]
    write_results(bare, {"suite": msgspec.to_builtins(suite), "methods": {}, "origin": {}}, tmp_path / RESULTS_FILE)
    (tmp_path / "failure_1.jpg").write_bytes(b"an image")
    (tmp_path / "report.md").write_text("![1](failure_1.jpg)")
    assert run_command_line(["report", str(tmp_path), "--page", str(tmp_path)]) == 0
    assert (tmp_path / "failure_1.jpg").read_bytes() == b"an image"
    page = (tmp_path / "report.md").read_text()
    assert "traces.svg" not in page
    assert not (tmp_path / "traces.svg").exists()
    assert (tmp_path / "report.html").read_text().count("<svg") == 3
    for part in ("images of failures: the rows contain no traces", "Decision times of single requests"):
        assert part in page.partition("## Not measured")[2]
    assert "left out: Decision times of single requests" in capsys.readouterr().err
    assert run_command_line(["report", str(tmp_path), "--page", str(tmp_path / RESULTS_FILE)]) == 2
    assert "--page must be a folder" in capsys.readouterr().err


def test_a_report_of_one_idle_episode_is_complete(suite):
    idle = episode_row("B3", trace_t=[], trace_h=[], trace_delta=[], Delta=None, frequency=None, filter_us=[], shots=0)
    assert "Not measured" in render_html_report(ReportData(rows=[idle], suite=suite, config={}))
    assert all(len(line) == len(table.header) for table in all_tables([idle], {}) for line in table.rows)


def test_methods_are_in_the_order_of_the_main_table():
    assert methods_of([episode_row("M"), episode_row("B3"), episode_row("A1"), episode_row("B1")]) == (
        "B1",
        "B3",
        "M",
        "A1",
    )


def test_batched_requests_have_no_latency(tmp_path):
    for total, more in ((2.0, {}), (3.0, {"at_once": 1.0}), (9.0, {"at_once": 8.0})):
        answer = Proposal(
            text="{}", finish_reason=STOP, planner="it", constrained_by="", timings={"total": total, **more}
        )
        AnswerCache(tmp_path / "plans").put("it", plan_request(instruction=f"put the cube down, {total}"), answer)
    answers = AnswerCache(tmp_path / "plans").read_all()
    assert sorted(unbatched_latencies(answers)) == [2.0, 3.0]
    assert decision_latency_table(answers).rows == (("it", "2", "2.5", "2.95", "1", "1.12"),)
    assert decision_latency_table([]).rows == ()


def test_the_margins_table_counts_filtered_episodes_by_cause():
    rows = [
        episode_row("B3", seed=0, guarded=True, h_min=-4e-4, margin_causes=["perception_jump", "perception_jump"]),
        episode_row("B3", seed=1, guarded=True, h_min=1e-3, margin_causes=["attach_detach (introduced)"]),
        episode_row("B3", seed=2, guarded=True, h_min=-2e-3),
        episode_row("B3", seed=3, guarded=True, h_min=2e-3),
        episode_row("B1", seed=0, guarded=False, h_min=-0.1),
    ]
    table = margins_table(rows)
    assert table.header == ("episodes with", "B3")
    lines = dict(table.rows)
    assert lines["least h [mm]"] == "-2.00"
    assert len(lines) == 5
    shares = [lines[name] for name in lines if name != "least h [mm]"]
    assert shares == [format_number(share, "share") for share in (0.5, 0.25, 0.25, 0.25)]
    assert margins_table(rows[-1:]).rows == ()
