"""The report of made-up results: it says what was found, what was not, and is one file that works offline."""

import os
import re
import time
from itertools import pairwise
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest

from dualbrain.cli import evaluate
from dualbrain.cli.estimate import GUESS_LARGE_S, GUESS_S, GUESS_SMALL_S, guess
from dualbrain.cli.evaluate import narrowed
from dualbrain.cli.main import call
from dualbrain.cli.report import command_of, flown_on, results
from dualbrain.dashboard.evaluation_charts import COLOURS, MARKERS, curves, latencies, look, panels, together, traces
from dualbrain.dashboard.evaluation_page import write_page
from dualbrain.dashboard.evaluation_report import Shot, Told, facts, render_evaluation
from dualbrain.errors import InvalidSetup
from dualbrain.evaluation.changes import OF_MACHINES, changed, changes
from dualbrain.evaluation.contrasts import contrasts, pairs
from dualbrain.evaluation.cost import Cost
from dualbrain.evaluation.decisions import decision_grid, latencies_of
from dualbrain.evaluation.effort import effort
from dualbrain.evaluation.failure import class_of
from dualbrain.evaluation.gallery import chosen
from dualbrain.evaluation.grids import (
    Grid,
    cell,
    failures,
    families,
    methods_of,
    number,
    overview,
    throughput,
    violations,
)
from dualbrain.evaluation.markdown import grid_lines
from dualbrain.evaluation.method import METHODS
from dualbrain.evaluation.metrics import BY_NAME
from dualbrain.evaluation.missing import missing
from dualbrain.evaluation.origin import origin
from dualbrain.evaluation.planners import Sources
from dualbrain.evaluation.plans import Kept, Plans
from dualbrain.evaluation.report_tables import all_grids
from dualbrain.evaluation.runner import STAGES, Runner
from dualbrain.evaluation.statistics import Estimate
from dualbrain.evaluation.suite import Task, open_suite, read_suite
from dualbrain.evaluation.table_file import FILE, write_table
from dualbrain.evaluation.unit import units_of
from dualbrain.evaluation.words import KINDS, caption, cut, headline
from dualbrain.planner.asking import FREE_BY
from dualbrain.planner.protocol import STOP
from dualbrain.records import Proposal
from dualbrain.world.monitor import UNITS
from tests.evaluation.rows import COLLISION, MOVED, SPEED, row
from tests.evaluation.test_runner import SUITE, lines_of
from tests.planner.questions import request

FAILED = {"success": False, "claimed": False, "failure": "frequent takeover", "outcome": "taken_over"}
ASTRAY = {"success": False}
"""Done, says the robot; not so, says truth: `actuator`."""
KEPT = [Kept("it", "q", Proposal("{}", STOP, "it", "", {"total": total})) for total in (0.5, 2.0)]


@pytest.fixture(scope="module")
def suite():
    return read_suite(SUITE, "tiny.toml")


@pytest.fixture(scope="module")
def rows():
    """Two runs of two repetitions: without a filter every second episode collides and fails."""
    found = []
    for method in ("B1", "B3", "M"):
        for run in (0, 1):
            for k in (0, 1):
                hurt = method == "B1" and k == 1
                values = {"violations": (COLLISION,), "severity": 0.1, **FAILED} if hurt else {}
                found.append(row(method, run, seed=run, repetition=k, guarded=method != "B1", **values))
    return found


def test_an_overview_has_every_method_with_its_numbers(rows):
    grid = overview(rows)
    assert grid.head == ("metric", "B1", "B3", "M")
    lines = {line[0]: line[1:] for line in grid.rows}
    assert lines["violation rate"][0].startswith("50.0 %")
    assert lines["violation rate"][1].startswith("0.0 %")
    assert lines["Δ of successes"][0] == "–"
    assert lines["episodes (clusters)"] == ("4 (2)",) * 3


def test_a_table_of_many_methods_is_told_in_parts_that_keep_the_names_of_the_rows():
    head = ("metric", *(f"m{k}" for k in range(20)))
    grid = Grid("t", head, (("success", *map(str, range(20))), ("Δ", *map(str, range(100, 120)))))
    first, second = grid.parts()
    assert first[0] == ("metric", *head[1:11])
    assert second[0] == ("metric", *head[11:])
    assert [row[0] for row in second[1]] == ["success", "Δ"]
    assert [left + right[1:] for left, right in zip(first[1], second[1], strict=True)] == list(grid.rows)
    assert grid_lines(grid).count("| metric | " + " | ".join(head[11:]) + " |") == 1
    narrow = Grid("t", head[:12], (tuple(map(str, range(12))),))
    assert narrow.parts() == [(narrow.head, list(narrow.rows))]


def test_many_methods_are_drawn_in_panels_each_with_what_became_of_it():
    assert panels(("B1", "B3", "M", "M-half")) == [["B1", "B3", "M", "M-half"]]
    flown = methods_of([row(name, seed=1, repetition=0) for name in open_suite("ablations").methods])
    found = panels(flown)
    assert found[0] == ["B4", "M", "M-success", "M-half", "M-double"]
    assert sorted(name for group in found for name in group) == sorted(flown)
    assert max(map(len, found)) <= len(MARKERS)


def test_numbers_as_people_read_them():
    assert [number(value, "share") for value in (0.123, float("nan"))] == ["12.3 %", "–"]
    assert number(-0.0012345) == "−0.00123"
    assert cell(Estimate(0.5, 0.1, 0.4, 0.6, 10, 5), "1") == "0.5 ± 0.1 [0.4, 0.6]"
    assert cell(Estimate(0.5, 0.5, -np.inf, np.inf, 10, 1), "1") == "0.5 ± 0.5"


def test_what_sums_leave_of_nothing_is_told_as_nothing():
    assert [number(value) for value in (1.41e-17, -3e-16, 2.07e-7)] == ["0", "0", "2.07e−07"]


def test_the_gate_is_told_in_milliseconds_and_whose_time_that_is(rows):
    grid = overview(rows)
    (line,) = (line for line in grid.rows if line[0].startswith("gate time"))
    assert line[0] == "gate time [ms]"
    assert line[1].startswith("0.1 ")  # of 1e-4 s
    assert "shares its processor" in grid.note


def test_what_could_not_be_is_not_told_as_a_share_of_nothing():
    bound, free = ({"constrained_by": by} for by in ("llguidance 1.9.1", f"{FREE_BY}; header given"))
    lines = {line[0]: line for line in violations([row("B1", **bound), row("B3", **free), row("A1")]).rows}
    told = lines["unauthorised skill"]
    assert told[1] == "–"
    assert [cell.split()[0] for cell in told[2:]] == ["0.0", "0.0"]  # nothing bound them
    assert lines["collision with a person"][1].startswith("0.0 %")
    assert violations([row("B1", **bound)]).note.endswith("that nobody holds")
    mixed = [row("B1", **bound), row("B1", 1, **free)]
    assert {line[0]: line for line in violations(mixed).rows}["unauthorised skill"][1].startswith("0.0 %")
    assert "grammar" not in violations(mixed).note


def test_every_kind_of_violation_has_words():
    assert KINDS.keys() == UNITS.keys()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"violations": (SPEED,)}, "succeeded, with a violation: tool speed"),
        ({"violations": (MOVED, COLLISION)}, "succeeded but unsafe: other thing moved, collision with the environment"),
        ({"success": False, "violations": (SPEED,)}, "actuator"),
    ],
)
def test_a_picture_is_headed_by_what_went_wrong_in_words(values, said):
    """Unsafe is what the table counts as unsafe, and nothing else."""
    told = row(**values)
    assert headline(told) == said
    unsafe = BY_NAME["succeeded but unsafe"].of(told)
    assert said.startswith("succeeded but unsafe") == bool(unsafe)


def test_a_caption_is_a_sentence_that_ends_behind_a_word():
    done = {"success": False, "reason": "above clear_glass", "task": "t", "seed": 7}
    assert caption(row(**done), COLLISION) == "Collision with the environment, hand × cup, at 1.0 s (t, seed 7)"
    assert caption(row(**done, meant=False), None) == (
        "The contract was carried out, “above clear_glass”, and is about something else than what was asked (t, seed 7)"
    )
    assert caption(row(**done), None).startswith("The robot holds it to be done, “above clear_glass”; on truth it is")
    ended = {"claimed": False, "outcome": "taken_over", "reason": "no safe control: " + "full speed " * 20}
    told = caption(row(**done | ended), None)
    assert told.startswith("The local layer ended it: no safe control: full speed")
    assert re.search(r"(full|speed) … \(t, seed 7\)$", told)
    assert cut("one two three", 7) == "one two …"
    assert cut("one two three", 13) == "one two three"


def test_a_report_tells_where_it_comes_from_and_lacks_what_older_runs_did_not_write(suite, tmp_path):
    known = {
        "origin": {"code": "abc", "machine": "Linux x86_64", "numpy": "2.4.6", "torch": "2.13"},
        "host": {"processor": "Sparrow 3", "cores": "2", "memory": "3.8 GiB", "revision": "deadbeef-dirty"},
    }
    rows = [row("M", epsilon=0.00207), row("M-half", epsilon=0.001), row("Full", epsilon=0.00207), row("B3")]
    told = Told(rows, suite, known, command="again")
    found = facts(told)
    assert found["machine"] == "Linux x86_64, Sparrow 3, 3.8 GiB, 2 cores"
    assert found["packages"] == "numpy 2.4.6, torch 2.13"
    assert found["ε"] == "0.00207 on panda (M, Full); 0.001 on panda (M-half)"
    write_page(tmp_path, told)
    for page in (render_evaluation(told), (tmp_path / "report.md").read_text().replace("\\", "")):
        for part in ("deadbeef-dirty", "Sparrow 3", "torch 2.13", "0.00207 on panda"):
            assert part in page
    older = facts(Told([row("B3")], suite, {}))
    assert (older["revision"], older["machine"], older["packages"]) == ("not recorded",) * 3
    assert "ε" not in older


def test_no_two_methods_of_a_chart_look_alike_and_neighbours_differ_in_colour_and_dash():
    looks = [look(k) for k in range(len(MARKERS))]
    assert all(a != b for k, a in enumerate(looks) for b in looks[k + 1 :])
    pairs = list(pairwise(looks))
    assert all(a["color"] != b["color"] and a["linestyle"] != b["linestyle"] for a, b in pairs)
    chart = curves([row(name, seed=1) for name in open_suite("ablations").methods])
    assert len(set(re.findall(r"var\(--([a-z]+)\)", chart))) >= len(COLOURS)


def test_methods_that_came_out_alike_are_one_line_and_each_violation_is_marked():
    same, hurt = row("B1"), row("M", violations=(COLLISION, MOVED))
    here = {"B1": same, "B2": row("B2"), "B3": row("B3", trace_h=[0.02, 0.005]), "M": hurt}
    assert together(here, ("B1", "B2", "G", "B3", "M")) == [["B1", "B2"], ["B3"], ["M"]]
    chart = traces(list(here.values()))
    assert ">B1 = B2<" in chart
    assert chart.count(">time [s]<") == 2  # under each panel
    marks = re.findall(r'<use [^>]*xlink:href="#(m[0-9a-f]+)"', chart)
    without = re.findall(r'<use [^>]*xlink:href="#(m[0-9a-f]+)"', traces([*here.values()][:3]))
    assert len(marks) >= len(without) + 2
    assert "no traces in this table" in traces([row("B1", trace_t=[], trace_h=[], trace_delta=[])])


def test_axes_of_latencies_say_what_they_show(rows):
    chart = latencies(rows, [0.5, 2.0])
    for words in ("share of measurements below", "time [s]", "time [ms]", "time [µs]"):
        assert f">{words}<" in chart


def test_a_family_is_told_as_a_whole_and_level_by_level():
    two = [row("B3", run, seed=run, task=f"edge_rescue {level}", success=level == "I")
           for level in ("I", "II") for run in range(3)]  # fmt: skip
    lines = {line[0]: line[1] for line in families(two).rows}
    shares = [lines[f"panda edge_rescue{part}: success"].split("%")[0] for part in ("", " I", " II")]
    assert shares == ["50.0 ", "100.0 ", "0.0 "]
    assert "panda edge_rescue: success" not in {line[0] for line in families(two[:3]).rows}


def test_what_is_compared_is_declared_and_nothing_else():
    told = {(a, b): switch for switch, a, b in pairs(tuple(METHODS))}
    assert told["G", "B3"] == "guard"
    assert told["B4", "M"] == told["P", "Full"] == told["Full", "Full-static"] == "memory"
    assert told["PE", "P"] == told["M", "Full"] == told["P", "P-no-kl"] == "asks"
    assert told["Full", "Full-success"] == "asks, signal"
    assert told["A1", "A3"] == "door, guard"
    assert {b for _, b in told} == set(METHODS) - {"B1", "A1"}  # every arm has something that it came from
    assert ("B1", "B3") not in told
    assert ("P-no-kl", "P-all") not in told
    assert not list(pairs(("B3", "P-all")))
    rows = [
        row(name, run, seed=run, success=name == "B3", guarded=name == "B3") for name in ("G", "B3") for run in range(9)
    ]
    lines = {line[2]: line for line in contrasts(rows).rows}
    assert lines["success"][:2] + lines["success"][3:5] == ("guard", "B3 − G", "100.0 %", "[100.0 %, 100.0 %]")
    assert float(lines["success"][5]) < 0.05
    assert "Δ of successes" not in lines  # an arm without filter has none


def test_what_is_alike_everywhere_is_no_test_that_others_are_corrected_for():
    rows = [row(name, run, seed=run, success=name == "B3" or run > 5) for name in ("G", "B3") for run in range(12)]
    lines = {line[2]: line for line in contrasts(rows).rows}
    assert lines["violation rate"][5] == "–"
    assert lines["success"][5] == number(2 / 2**6)


def test_failures_add_up(rows):
    lines = {line[0]: line[1:] for line in failures(rows).rows}
    assert lines["frequent takeover"] == lines["all failures"] == ("2", "0", "0")


def test_failures_are_told_by_the_rule_of_today_whatever_their_rows_say(rows):
    before = [msgspec.structs.replace(one, failure="actuator") if one.failure else one for one in rows]
    assert failures(before) == failures(rows)
    assert [one.key for one in chosen(before, 9)] == [one.key for one in chosen(rows, 9)]


def test_shares_of_the_wall_time_are_shares_and_one_flight_that_stood_still_moves_no_throughput():
    """Parts overlapped in tables of before, and the whole was too short."""
    wall = {"physics": 3.0, "monitor": 1.0, "filter": 0.5, "planner": 1.5, "rest": 0.0}
    flights = [row("B3", seed=seed, wall_s=2.0, wall=wall, simulated_s=12.0) for seed in range(9)]
    (told,) = throughput(flights).rows
    assert told[1:3] == ("600", "2.00")
    assert sum(float(share.removesuffix(" %")) for share in told[3:]) == pytest.approx(100.0, abs=0.2)
    stalled = row("B3", seed=9, wall_s=925.0, wall=wall | {"physics": 922.0}, simulated_s=12.0)
    assert throughput([*flights, stalled]).rows[0][1:3] == ("600", "2.00")
    assert float(throughput([*flights, stalled]).rows[0][3].removesuffix(" %")) < 56.0  # a tenth of the flights
    assert "median" in throughput(flights).note


def test_what_was_not_measured_is_said(rows, suite):
    said = " ".join(missing(rows, suite))
    for part in ("on one", "Full (", "H2", "retrieval utility", "language model", "hazardous", "100 episodes"):
        assert part in said
    cost = Cost("1", "base", 100, 60, 5, bootstrapped=True)
    assert any("others proposed" in one for one in missing(rows, suite, {"adapted": cost}))
    assert not any("others proposed" in one for one in missing(rows, suite, {"base": cost}))


def test_the_gallery_shows_as_many_classes_and_methods_as_it_can():
    some = [
        row(method, k, key=f"{method}{k}", **ASTRAY | values)
        for k, (method, values) in enumerate(
            [("B1", {}), *2 * [("B1", {"perceived_error": 1.0})], ("B1", {"frequency": 0.6})]
        )
    ]
    assert {class_of(one) for one in chosen(some, 3)} == {"actuator", "perception", "frequent takeover"}
    assert chosen([*some, row("B2", key="idle", **ASTRAY, trace_t=[])], 9) != []
    assert "idle" not in [one.key for one in chosen([row("B2", key="idle", **ASTRAY, trace_t=[])], 9)]


def test_the_gallery_shows_a_flight_once_and_other_scenes_before_the_same_again():
    flown = row("B1", key="flown", **ASTRAY, severity=0.9)
    shared = row("B2", key="shared", **ASTRAY, severity=0.9, same_as="flown")
    again = row("G", repetition=1, key="again", **ASTRAY, severity=0.8)
    elsewhere = row("B1", seed=7, key="elsewhere", **ASTRAY, severity=0.1)
    assert [one.key for one in chosen([flown, shared, again, elsewhere], 9)] == ["flown", "elsewhere", "again"]


def test_the_page_is_one_file_without_script_and_escapes_what_it_is_told(rows, suite):
    evil = row("M", 1, seed=9, instruction="<script>alert(1)</script>", planner="<b>template</b>")
    shots = [Shot(rows[1], "<img src=x>", np.zeros((48, 64, 3), np.uint8))]
    page = render_evaluation(Told([*rows, evil], suite, {"origin": {"code": "abc"}}, KEPT, shots, "2026-11-21"))
    assert "<script" not in page
    assert "<b>template" not in page
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page)
    for part in (
        "missed deadline",
        "H1",
        "Methods and metrics",
        "Over repetitions",
        "Latency",
        "What was not measured",
        "&lt;img src=x",
    ):
        assert part in page
    assert page.count("<svg") == 3


def test_the_markdown_page_shows_pictures_that_lie_beside_it_and_escapes_what_it_is_told(rows, suite, tmp_path):
    shots = [Shot(rows[1], "<img src=x> [a](b) `c`", np.zeros((48, 64, 3), np.uint8))]
    for left_over in ("failure_1.jpg", "failure_2.jpg", "failure_cam.jpg", "failure_7.jpg"):
        (tmp_path / left_over).write_bytes(b"of a larger gallery")
    (tmp_path / "report.md").write_text("![1](failure_1.jpg)\n![2](failure_2.jpg)\n")
    write_page(tmp_path, Told(rows, suite, {"origin": {"code": "abc"}}, KEPT, shots, "2026-11-21", "again"))
    page = (tmp_path / "report.md").read_text()
    for part in (
        "## Hypotheses",
        "12 episodes, 2026-11-21, code abc, seeds 0 to 1 (2)",
        "Again: `again`",
        "not measured",
        "none is a missed deadline",
        "docs/kernel.md",
        "## Where this comes from",
    ):
        assert part in page
    assert r"\<img src=x\> \[a\](b) \`c\`" in page
    shown = re.findall(r"!\[.*?\]\(([a-z_0-9.]+)\)", page)
    assert shown == ["curves.svg", "traces.svg", "latencies.svg", "failure_1.jpg"]
    for name in shown:
        assert (tmp_path / name).stat().st_size > 300
    assert not (tmp_path / "failure_2.jpg").exists()
    assert (tmp_path / "failure_cam.jpg").exists()  # no picture of the page that was replaced
    assert (tmp_path / "failure_7.jpg").exists()
    chart = (tmp_path / "curves.svg").read_text()
    assert "mathdefault" not in (tmp_path / "latencies.svg").read_text()  # ticks are numbers, no formulas to be set
    assert ElementTree.fromstring(chart).tag.endswith("svg")
    assert set(re.findall(r"var\((--[a-z]+)\)", chart)) <= set(re.findall(r"(--[a-z]+):", chart))


def test_a_page_elsewhere_has_the_table_of_all_episodes_beside_it(rows, suite, tmp_path):
    folder, page = tmp_path / "run", tmp_path / "page"
    folder.mkdir()
    write_table(rows, {"suite": msgspec.to_builtins(suite), "methods": {}, "origin": {}}, folder / FILE)
    whole = (folder / FILE).read_bytes()
    for place in (page, folder):
        assert call(["report", str(folder), "--gallery", "0", "--page", str(place)]) == 0
    assert (folder / FILE).read_bytes() == whole  # with its traces
    flown, config, _ = results(page)
    assert flown == [msgspec.structs.replace(one, trace_t=[], trace_h=[], trace_delta=[]) for one in results(folder)[0]]
    assert config["flown"] == flown_on(folder, {})
    assert call(["report", str(page), "--page", str(page)]) == 0


def test_a_page_made_again_from_a_table_without_traces_keeps_its_pictures_and_says_what_is_not_there(
    rows, suite, tmp_path, capsys
):
    bare = [msgspec.structs.replace(one, trace_t=[], trace_h=[], trace_delta=[]) for one in rows]
    write_table(bare, {"suite": msgspec.to_builtins(suite), "methods": {}, "origin": {}}, tmp_path / FILE)
    (tmp_path / "failure_1.jpg").write_bytes(b"flown once")
    (tmp_path / "report.md").write_text("![1](failure_1.jpg)")
    assert call(["report", str(tmp_path), "--page", str(tmp_path)]) == 0
    assert (tmp_path / "failure_1.jpg").read_bytes() == b"flown once"
    page = (tmp_path / "report.md").read_text()
    assert "traces.svg" not in page
    assert not (tmp_path / "traces.svg").exists()
    assert (tmp_path / "report.html").read_text().count("<svg") == 2
    for said in ("pictures of failures, chosen by them: no row", "How long each decision took"):
        assert said in page.partition("## What was not measured")[2]
    assert "left out: How long each decision took" in capsys.readouterr().err
    assert call(["report", str(tmp_path), "--page", str(tmp_path / FILE)]) == 2
    assert "--page: got" in capsys.readouterr().err


def test_a_page_of_nothing_flown_by_most_methods_still_stands(suite):
    idle = row("B3", trace_t=[], trace_h=[], trace_delta=[], Delta=None, frequency=None, filter_us=[], shots=0)
    assert "What was not measured" in render_evaluation(Told([idle], suite, {}))
    assert all(len(line) == len(grid.head) for grid in all_grids([idle], {}) for line in grid.rows)


def test_methods_come_in_the_order_of_the_main_table():
    assert methods_of([row("M"), row("B3"), row("A1"), row("B1")]) == ("B1", "B3", "M", "A1")


def test_changes_name_the_direction_and_only_common_places():
    before = [row("B3", run, seed=run, frequency=0.20 + 0.01 * run) for run in range(8)]
    after = [row("B3", run, seed=run, frequency=0.10 + 0.01 * run) for run in range(10)]
    lines = {line[1]: line for line in changes(before, after).rows}
    assert lines["intervention frequency"][-1] == "better"
    assert lines["intervention frequency"][-2] == "8"
    assert lines["success"][-1] == "the same"
    assert BY_NAME["intervention frequency"].better == -1


def flown_twice(runs=8, **values):
    """Two evaluations in which B3 differs in all of `values`: before, and after by the run."""
    before = [row("B3", run, seed=run) for run in range(runs)]
    later = [{name: of(run) for name, of in values.items()} for run in range(runs)]
    return before, [msgspec.structs.replace(one, **new) for one, new in zip(before, later, strict=True)]


def test_what_a_change_is_called_goes_by_the_corrected_p():
    """Six clusters of eight got better: the interval leaves out 0, and among several tests that is too little."""
    told = {
        one.metric.name: one
        for one in changed(*flown_twice(frequency=lambda k: 0.1 + 0.12 * (k < 2), severity=lambda k: k % 2))
    }
    found = told["intervention frequency"]
    assert found.found.high < 0.0
    assert found.found.p < 0.05 < found.p
    assert found.word == "no clear change"
    assert told["success"].word == "the same"
    one_cluster = {one.metric.name: one for one in changed(*flown_twice(1, frequency=lambda k: 0.1))}
    assert one_cluster["intervention frequency"].word == one_cluster["success"].word == "not known"


def test_what_is_alike_or_of_the_machine_makes_the_correction_of_nothing_larger():
    slower = flown_twice(gate_s=lambda k: 1.0, filter_us=lambda k: [80.0 + k] * 3, severity=lambda k: 0.1 + k)
    told = {one.metric.name: one for one in changed(*slower)}
    assert told["severity"].p == told["severity"].found.p == 2 / 2**8
    for name in OF_MACHINES:
        assert np.isnan(told[name].p)
        assert told[name].word == "of the machine"
    line = next(line for line in changes(*slower).rows if line[1] == "gate time")
    assert line[4] == "–"


def test_in_what_two_evaluations_were_set_up_otherwise_is_told(rows, tmp_path, capsys):
    ours = read_suite(SUITE, "tiny.toml")
    theirs = msgspec.structs.replace(ours, methods=("B1", "B3"), planners={"base": "base-135m"}, says="Another.",
                                     tasks=(*ours.tasks, Task("edge_rescue", "II")))  # fmt: skip
    for name, suite, code in (("one", ours, "abc"), ("two", theirs, "def")):
        arms = {method: METHODS[method] for method in suite.methods}
        config = {"suite": suite, "methods": arms, "origin": {"code": code, "python": "3"}, "adapters": {}}
        config = msgspec.json.decode(msgspec.json.encode(config))
        (tmp_path / name).mkdir()
        write_table(rows[:1] if name == "one" else rows, config, tmp_path / name / FILE)
    lines = [
        ("origin.code", "abc", "def"), ("suite.methods", "M", "–"), ("suite.planners.base", "template", "base-135m"),
        ("suite.tasks", "–", "edge_rescue II errand all"),
    ]  # fmt: skip
    pair = [str(tmp_path / "one"), str(tmp_path / "two")]
    assert call(["compare", *pair]) == 0
    said = capsys.readouterr().out
    for line in lines:
        assert f"| {' | '.join(line)} |" in said
    assert "python" not in said
    assert call(["compare", *pair, "--json"]) == 0
    told = msgspec.json.decode(capsys.readouterr().out)
    assert told["configuration"] == {what: {"before": a, "after": b} for what, a, b in lines}
    found = next(one for one in told["changes"] if one["metric"] == "success")
    assert found == {
        "method": "B1", "metric": "success", "unit": "rate", "change": 0.0, "low": None, "high": None, "p": None,
        "clusters": 1, "word": "not known",
    }  # fmt: skip
    assert call(["compare", *pair[:1] * 2]) == 0
    assert "None." in capsys.readouterr().out


def test_seconds_are_lost_only_by_what_succeeded_on_truth():
    of = BY_NAME["seconds lost"].of
    told = row("B3", seed=1, repetition=0, lost_s=3.0, success=True)
    assert of(told) == 3.0
    assert of(msgspec.structs.replace(told, success=False)) is None


def test_changes_pair_places_however_they_were_dealt_to_runs():
    def flown(runs, first=0):
        return [
            row("B3", run=seed % runs, seed=seed, repetition=0, frequency=seed / 100, instruction="a")
            for seed in range(first, first + 10)
        ]

    def told(before, after):
        return next(line for line in changes(before, after).rows if line[1] == "intervention frequency")

    for before, after in ((flown(5), flown(2)), (flown(10), flown(1)), (flown(5), flown(5, first=1))):
        assert told(before, after)[-1] == "the same"
    other = [msgspec.structs.replace(one, instruction="b") for one in flown(5)]
    assert not changes(flown(5), other).rows


def test_an_episode_of_results_is_flown_again_whatever_suite_is_named(tmp_path, capsys):
    assert call(["evaluate", "--suite", "smoke", "--methods", "B1", "--episodes", "1", "--jobs", "1",
                 "--out", str(tmp_path)]) == 0  # fmt: skip
    key = results(tmp_path)[0][0].key
    for name in ("config.json", "fly.jsonl"):  # what a repository keeps is the table
        (tmp_path / name).unlink()
    assert call(["evaluate", "--suite", "first", "--out", str(tmp_path), "--again", key]) == 0
    assert "as recorded" in capsys.readouterr().err
    assert call(["evaluate", "--out", str(tmp_path), "--again", "nothing"]) == 5
    assert key in capsys.readouterr().err
    assert call(["evaluate", "--jobs", "-1"]) == 2


def test_commands_read_results(rows, suite, tmp_path, capsys):
    config = {"suite": msgspec.to_builtins(suite), "methods": {}, "origin": {"code": "abc"}}
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        write_table(rows, config, tmp_path / name / FILE)
    assert call(["report", str(tmp_path / "one"), "--gallery", "0", "--json"]) == 0
    told = msgspec.json.decode(capsys.readouterr().out)
    assert [one["name"] for one in told] == ["H1", "H2", "H3"]
    assert "## Hypotheses" in (tmp_path / "one" / "page" / "report.md").read_text()
    assert (tmp_path / "one" / "report.html").stat().st_size > 20_000
    assert call(["compare", str(tmp_path / "one"), str(tmp_path / "two")]) == 0
    assert "| B1 | success | 0.0 % |" in capsys.readouterr().out
    nothing, page = tmp_path / "nothing", tmp_path / "page"
    page.mkdir()
    (page / "report.md").write_text("Again: `dualbrain evaluate --suite attacks --out attacks`")
    for command in (["report"], ["compare", str(tmp_path / "one")]):
        assert call([*command, str(nothing)]) == 5
        assert f"dualbrain evaluate --suite SUITE --out {nothing}" in capsys.readouterr().err
        assert call([*command, str(page)]) == 5
        told = capsys.readouterr().err
        assert "into another folder" in told
        assert "--out" not in told
        assert call([*command, str(tmp_path / "one" / FILE)]) == 5
        assert "Name the folder" in capsys.readouterr().err


def test_a_run_under_way_can_be_read(tmp_path):
    """Before the table is written there are only journals; a folder in which nothing is flown yet has no results."""
    suite = read_suite(SUITE, "tiny.toml")
    runner = Runner(suite, tmp_path, clock=lambda: 0.0, tell=lambda progress: None)
    runner.prepare({"code": "abc"})
    with pytest.raises(InvalidSetup, match=rf"no episode that is finished.*--suite FILE.toml --out {tmp_path}"):
        results(tmp_path)
    run = next(unit for unit in units_of(suite, "fly") if unit.method == "M")
    for line in list(lines_of(run))[:4]:
        runner.journal("fly").append(line)
    found, config, told = results(tmp_path)
    assert found == runner.rows()
    assert [one.key for one in found] == [run.row_key(order) for order in range(4)]
    assert (config["origin"], told) == ({"code": "abc"}, suite)
    write_table(found, config, tmp_path / FILE)
    assert results(tmp_path)[0] == found
    runner.journal("fly").append(list(lines_of(run))[4])  # taken up again, after a table was written
    os.utime(tmp_path / FILE, ns=(0, 0))
    assert len(results(tmp_path)[0]) == 5


@pytest.fixture
def begun(tmp_path):
    """A folder of suite `smoke`, two episodes into its flights."""
    runner = Runner(open_suite("smoke"), tmp_path / "begun", clock=time.perf_counter, tell=print)
    runner.prepare(origin())
    for unit in units_of(runner.suite, "fly")[:2]:
        runner.journal("fly").append(next(iter(lines_of(unit))))
    return runner


def test_a_command_to_go_on_is_the_whole_one(begun, capsys):
    (begun.out / "fly.jsonl").unlink()
    assert call(["report", str(begun.out)]) == 5
    assert f"Go on with it: dualbrain evaluate --suite smoke --out {begun.out}" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [b"{", b"[]", b"\xff"])
def test_a_configuration_that_cannot_be_read_is_told_with_its_file(begun, capsys, damage):
    out = begun.out
    (out / "config.json").write_bytes(damage)
    for asked in (["report", out], ["evaluate", "--out", out, "--jobs", "1"], ["evaluate", "--dry-run", "--out", out]):
        assert call(list(map(str, asked))) == 5
        said = capsys.readouterr().err
        assert "configuration of the results" in said
        assert f"Bring back a copy, or name another --out. {out / 'config.json'}" in said
        assert "Traceback" not in said
    write_table(begun.rows(), {"suite": msgspec.to_builtins(begun.suite), "origin": {}}, out / FILE)
    os.utime(out / FILE, ns=(0, 0))  # taken up again after it was written
    assert call(["report", str(out)]) == 0
    assert "left out: What was flown since results.parquet" in capsys.readouterr().err


@pytest.mark.parametrize("lost", ["wall_s", "key"])
def test_a_line_that_lacks_something_is_told_and_the_rest_reported(begun, capsys, lost):
    path = begun.out / "fly.jsonl"
    first, second = map(msgspec.json.decode, path.read_bytes().splitlines())
    del second[lost]
    path.write_bytes(msgspec.json.encode(first) + b"\n" + msgspec.json.encode(second) + b"\n")
    assert call(["report", str(begun.out)]) == 0
    assert f"left out: Line 2 of fly.jsonl (Object missing required field `{lost}`)" in capsys.readouterr().err
    page = (begun.out / "page" / "report.md").read_text()
    assert "Line 2 of fly.jsonl" in page.partition("## What was not measured")[2]
    assert "1 episodes" in page
    for more in ((), ("--dry-run",)):
        assert call(["evaluate", "--suite", "smoke", "--jobs", "1", "--out", str(begun.out), *more]) == 5
        said = capsys.readouterr().err
        assert "line 2 of fly.jsonl" in said
        assert f"Delete it (where memory grows, all lines of its run): what it told is flown again. {path}" in said


def test_a_line_of_questions_that_lacks_something_is_told_too(begun, capsys):
    begun.journal("plan").append({"key": "B3 #0", "asked": 1})
    assert call(["evaluate", "--suite", "smoke", "--dry-run", "--out", str(begun.out)]) == 5
    assert "line 1 of plan.jsonl" in capsys.readouterr().err


def test_a_damaged_answer_is_left_out_of_a_report_and_asked_for_again(begun, capsys):
    plans = Plans(begun.out / "plans")
    for words in ("put the cube down", "pick the cube up"):
        plans.keep("it", request(instruction=words), Proposal("{}", STOP, "it", "", {"total": 1.0}))
    torn = next(iter((begun.out / "plans").glob("*.json")))
    torn.write_bytes(torn.read_bytes()[:20])
    assert call(["report", str(begun.out)]) == 0
    assert f"left out: The answer in plans/{torn.name}, which is damaged" in capsys.readouterr().err
    assert len(plans.all()) == 1
    known = [plans.find("it", request(instruction=words)) for words in ("put the cube down", "pick the cube up")]
    assert known.count(None) == 1


def test_what_was_answered_side_by_side_is_no_latency(tmp_path):
    for total, more in ((2.0, {}), (3.0, {"at_once": 1.0}), (9.0, {"at_once": 8.0})):
        answer = Proposal("{}", STOP, "it", "", {"total": total, **more})
        Plans(tmp_path / "plans").keep("it", request(instruction=f"put the cube down, {total}"), answer)
    kept = Plans(tmp_path / "plans").all()
    assert sorted(latencies_of(kept)) == [2.0, 3.0]
    assert decision_grid(kept).rows == (("it", "2", "2.5", "2.95", "1", "1.12"),)
    assert decision_grid([]).rows == ()


def test_a_report_is_dated_by_its_last_flight(tmp_path):
    for name, day in (("results.parquet", 20_000), ("fly.jsonl", 10_000)):
        (tmp_path / name).write_text("")
        os.utime(tmp_path / name, (86_400 * day, 86_400 * day))
    assert flown_on(tmp_path, {"flown": "2001-01-01"}) == "1997-05-19"
    (tmp_path / "fly.jsonl").unlink()
    assert flown_on(tmp_path, {"flown": "2001-01-01"}) == "2001-01-01"
    assert flown_on(tmp_path, {}) == "2024-10-04"


def test_a_suite_that_no_options_lead_to_came_from_a_file(tmp_path):
    ours = open_suite("smoke")
    for other in (msgspec.structs.replace(ours, name="mine"), msgspec.structs.replace(ours, shots=ours.shots + 1)):
        assert "--suite FILE.toml" in command_of(other, tmp_path / "there")


def test_a_report_says_by_which_command_it_comes_again(tmp_path):
    asked = ("paper", "B1,M", "200", "panda", "base=transformers:base-135m")
    for told in (asked, ("paper", "", "0", "", ""), ("attacks", "", "0", "base", "")):
        flown = narrowed(told[0], told[1], int(told[2]), told[3], told[4] or "adapted=adapter:x")
        command = command_of(flown, tmp_path / "there").split()
        assert command[:2] == ["dualbrain", "evaluate"]
        said = dict(zip(command[2::2], command[3::2], strict=True))
        assert said.pop("--out") == "there"
        again = [said.get(f"--{name}", "") for name in ("suite", "methods", "episodes", "robots", "planner")]
        assert narrowed(again[0], again[1], int(again[2] or 0), again[3], again[4]) == flown


def test_a_dry_run_flies_nothing_and_says_how_long(tmp_path, capsys):
    asked = ["evaluate", "--suite", "smoke", "--dry-run", "--json", "--episodes", "3", "--out", str(tmp_path / "x")]
    assert call([*asked, "--methods", "B1,M"]) == 0
    told = msgspec.json.decode(capsys.readouterr().out)
    assert told["left"] == {"pilot": 0, "start": 1, "plan": 0, "fly": 6}
    assert told["basis"] == "a guess"
    assert not (tmp_path / "x").exists()
    assert call(["evaluate", "--methods", "B9", "--dry-run"]) == 5
    assert call(["evaluate", "--suite", "paper", "--dry-run"]) == 5
    assert "--planner adapted=adapter:ID" in capsys.readouterr().err
    named = "adapted=base-135m,base=template"
    assert call(["evaluate", "--suite", "paper", "--dry-run", "--planner", named, "--out", str(tmp_path / "y")]) == 0


def test_a_guess_of_a_dry_run_is_that_of_the_model_that_answers(tmp_path, capsys):
    sources = Sources(tmp_path, tmp_path)
    for small in ("base-135m", "adapter:starter-135m", "transformers:base-135m", "smollm2-135m-instruct"):
        assert guess(small, sources) == GUESS_SMALL_S
    for large in ("qwen2.5-coder-1.5b-instruct", "transformers:qwen2.5-coder-1.5b-instruct", "http://host/v1"):
        assert guess(large, sources) == GUESS_LARGE_S
    asked = ["evaluate", "--suite", "paper", "--methods", "B3,P", "--dry-run", "--json", "--jobs", "1"]
    asked += ["--planner", "base=template,prompted=template,adapted=base-135m", "--out", str(tmp_path / "x")]
    assert call(asked) == 0
    one = msgspec.json.decode(capsys.readouterr().out)
    assert one["question_s"] == {"base-135m": GUESS_SMALL_S}
    assert one["episode_s"] == GUESS_S
    asked[asked.index("--planner") + 1] = "base=qwen2.5-coder-1.5b-instruct,adapted=base-135m"
    assert call(asked) == 0
    both = msgspec.json.decode(capsys.readouterr().out)
    assert both["question_s"] == {"qwen2.5-coder-1.5b-instruct": GUESS_LARGE_S, "base-135m": GUESS_SMALL_S}
    suite = narrowed("paper", "B3", 0, "", "base=qwen2.5-coder-1.5b-instruct")
    units = [unit for stage in STAGES for unit in units_of(suite, stage)]
    more = effort(suite, units).questions * GUESS_LARGE_S / 3600.0
    assert both["hours"]["planning"] - one["hours"]["planning"] == pytest.approx(more)


def test_what_was_measured_in_a_folder_comes_before_a_guess_planner_by_planner(tmp_path, capsys):
    asked = ["evaluate", "--suite", "paper", "--methods", "B3,P", "--dry-run", "--json", "--out", str(tmp_path)]
    asked += ["--planner", "adapted=starter-135m"]
    runner = Runner(narrowed("paper", "B3,P", 0, "", "adapted=starter-135m"), tmp_path, clock=time.perf_counter,
                    tell=print)  # fmt: skip
    unit = next(unit for unit in units_of(runner.suite, "plan") if unit.method == "P")
    for order, (new, seconds) in enumerate([(1, 7.0), (0, 0.0), (1, 9.0)]):
        runner.journal("plan").append({"key": unit.row_key(order), "asked": new, "planner_s": seconds})
    flown = next(iter(lines_of(units_of(runner.suite, "fly")[0])))
    runner.journal("fly").append(flown | {"wall_s": 11.0})
    assert call(asked) == 0
    told = msgspec.json.decode(capsys.readouterr().out)
    assert told["question_s"] == {"base-135m": GUESS_SMALL_S, "starter-135m": 8.0}
    assert (told["episode_s"], told["basis"]) == (11.0, "measured here")


def test_methods_that_fly_a_single_run_are_warned_of(tmp_path, capsys, monkeypatch):
    said = "fewer than two runs of B1, B3: the report will have no interval"
    monkeypatch.setattr(evaluate, "_passes", lambda *_: True)
    for more in (("--dry-run",), ()):
        asked = ["evaluate", "--methods", "B1,B3", "--planner", "template", "--out", str(tmp_path), *more]
        assert call([*asked, "--suite", "smoke", "--episodes", "5"]) == 0
        assert said in capsys.readouterr().err
    assert call(["evaluate", "--methods", "B1", "--suite", "first", "--dry-run"]) == 0
    assert "fewer than two runs" not in capsys.readouterr().err
    suite = open_suite("refusals")
    assert [suite.clusters(name) for name in ("B1", "P")] == [6 * 20, 3 * 20]
    assert open_suite("paper").clusters("B3") == 40


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (("--suite", "smoke", "--planner", "nosuch"), 5, "base-135m"),
        (("--suite", "smoke", "--planner", "foo=template"), 5, "adapted_no_kl"),
        (("--suite", "smoke", "--planner", "base="), 2, "PART=PLANNER"),
        (("--suite", "smoke", "--planner", "base=template,base=adversary"), 2, "each part once"),
        (("--suite", "paper", "--planner", "adapted=adapter:deadbeef"), 5, "deadbeef"),
        (("--suite", "smoke", "--methods", "B1,B1,B3"), 5, "B1 twice"),
        (("--suite", "smoke", "--methods", "B1,"), 2, "--methods: got 'B1,'"),
        (("--suite", "smoke", "--robots", "panda,"), 2, "--robots: got 'panda,'"),
        (("--suite", "smoke", "--robots", "base"), 5, "clutter_grasp I: panda, "),
        (("--suite", "refusals", "--robots", "ur5e", "--planner", "adapted=base-135m"), 5, "hazardous: panda;"),
        (("--suite", "paper", "--methods", "B3-depth"), 5, "Leave out B3-depth"),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused_by_a_dry_run_too(tmp_path, capsys, monkeypatch, more, code, said):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    for asked in (more, (*more, "--dry-run")):
        assert call(["evaluate", *asked, "--out", str(tmp_path / "x")]) == code
        assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_a_dry_run_refuses_a_folder_that_could_not_be_gone_on_with(tmp_path):
    asked = ["evaluate", "--suite", "smoke", "--dry-run", "--out", str(tmp_path)]
    smoke = open_suite("smoke")
    Runner(smoke, tmp_path, clock=time.perf_counter, tell=print).prepare(origin())
    assert call(asked) == 0
    assert call([*asked, "--methods", "B1"]) == 5  # all that is there has to be named
    (tmp_path / "config.json").unlink()
    Runner(smoke, tmp_path, clock=time.perf_counter, tell=print).prepare({**origin(), "code": "another"})
    assert call(asked) == 5


@pytest.mark.parametrize(
    ("more", "missing"),
    [
        (("--suite", "smoke"), "minilm-l6-v2-int8"),
        (("--suite", "smoke", "--methods", "B1", "--planner", "qwen2.5-coder-1.5b-instruct"), "qwen2.5-coder-1.5b"),
        (("--suite", "smoke", "--methods", "B1", "--planner", "transformers:base-135m"), "smollm2-135m-instruct"),
        (("--suite", "smoke", "--methods", "P", "--planner", "adapted=adapter:aa"), "adapter"),
    ],
)
def test_weights_that_are_not_there_are_missed_once_and_before_anything_is_flown(
    tmp_path, capsys, monkeypatch, more, missing
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    assert call(["evaluate", *more, "--jobs", "1", "--out", str(tmp_path / "x")]) == 5
    said = capsys.readouterr().err
    assert missing in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "x" / "config.json").exists()


def test_cameras_that_cannot_see_are_missed_before_anything_is_flown(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert call(["evaluate", "--suite", "eyes", "--methods", "B3-depth", "--planner", "template",
                 "--out", str(tmp_path / "x")]) == 5  # fmt: skip
    said = capsys.readouterr().err
    assert "cameras of B3-depth" in said
    assert "apt-get install" in said
    assert not (tmp_path / "x").exists()


def test_who_interrupts_is_told_how_to_go_on(tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "_passes", interrupted)
    assert call(["evaluate", "--suite", "smoke", "--methods", "B1", "--out", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert "the same command goes on" in said
    assert "dualbrain: interrupted" in said


@pytest.mark.parametrize(("broken", "done"), [("plan", STAGES), ("pilot", ("pilot",)), ("", STAGES)])
def test_answers_that_are_missing_are_asked_for_in_flight_but_nothing_is_flown_without_epsilon(
    monkeypatch, broken, done
):
    begun = []
    monkeypatch.setattr(evaluate, "_stage", lambda runner, stage, *_: begun.append(stage) or stage != broken)
    assert evaluate._passes(None, STAGES, None, 1) == (not broken)
    assert tuple(begun) == done
