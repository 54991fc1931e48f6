"""Processor time of the live view: without a page, with one page, and with each further page.

Run: MUJOCO_GL=egl python -m scripts.measure_live_view [--seconds S] [--viewers N ...] [--repeats R] [--json]

The process that shows a run receives the tick reports of a gatekeeper. Here it receives recorded reports of the motion
in `scripts/filter_demo.py`, in which the arm moves all the time, forwards and backwards at the rate of a gatekeeper.
The viewers are pages in headless Chromium. The shares are processor time of the threads of this process, in percent of
one core; the browsers are other processes. A repeat measures all numbers of viewers, one after another. The number of
frames per second is smaller than that of the reports if other programs delay the view.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import chain, cycle
from math import isnan
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from rich.console import Console

from dualbrain.cli.run.live_feed import LiveFeed
from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.gatekeeper.gatekeeper import TICK_REPORT_PERIOD
from dualbrain.control.gatekeeper.protocol.messages import TickReport
from dualbrain.control.scene_smoothing import SceneSmoother
from dualbrain.records import Attempt, Episode, Proposal, Scene
from dualbrain.visualization.live.panel import MAX_HISTORY_POINTS
from dualbrain.visualization.live.view_state import ViewState
from scripts.filter_demo import ROBOT, DemoTick, open_demo_world, run_demo
from tests.visualization.headless_browser import Browser

PORT = 18960
WINDOW = (900, 700)
BROWSER_NICENESS = 19
SETTLING_TIME_S = 8.0
"""Time [s] in which new pages receive the whole scene, before the measurement."""
LOADED = "return document.getElementById('plain-step') && document.getElementById('db-state') ? true : null;"
CONTRACT = Contract(
    "c-0001",
    Context("panda", ""),
    (Action("grasp", {"object": "red_cube"}), Action("place", {"destination": "blue_bowl"})),
)
GROUPS = ("states", "drawing", "sending")
"""What the threads do: convert reports to states, draw them, and send messages and pages (the threads of viser)."""


def record_reports() -> list[TickReport]:
    """Tick reports of the motion, one each `TICK_REPORT_PERIOD` [s]."""
    reports: list[TickReport] = []
    smoother = SceneSmoother()
    for demo in run_demo(open_demo_world(), guard=True):
        scene = smoother.update(demo.scene)
        if not reports or demo.state.stamp - reports[-1].t >= TICK_REPORT_PERIOD:
            reports.append(report_of(demo, scene))
    return reports


def report_of(demo: DemoTick, scene: Scene) -> TickReport:
    """The report that a gatekeeper sends of a tick in the smoothed `scene`."""
    state, result = demo.state, demo.result
    return TickReport(
        t=state.stamp,
        scene=scene,
        q=tuple(state.q.tolist()),
        opening=state.opening,
        u=tuple(result.u.tolist()),
        delta=result.delta,
        h_min=None if isnan(result.h_min) else result.h_min,
        status=result.status.name,
        barriers=result.barriers,
        skill="place",
        phase="carry",
        in_contract=True,
        order="NONE",
        check="",
        u_nom=tuple(result.u_nom.tolist()),
        pairs=result.obstacle_pairs,
    )


class Player:
    """Plays the reports forwards and backwards without an end, at their rate; the time of a report is the real one."""

    def __init__(self, feed: LiveFeed, reports: list[TickReport], period: float) -> None:
        """Start at the first report; `period` [s] is the time between two."""
        self._feed, self._start = feed, time.monotonic()
        self.frames, draw = 0, feed.view._draw_one

        def count(state: ViewState | None, episode: Episode | None) -> None:
            self.frames += 1
            draw(state, episode)

        feed.view._draw_one = count
        self._reports, self._period = cycle(chain(reports, reversed(reports))), period

    def play(self, seconds: float) -> None:
        """Pass the reports of `seconds` to the feed."""
        due = start = time.monotonic()
        while due < start + seconds:
            self._feed.on_tick_report(replace(next(self._reports), t=due - self._start))
            due += self._period
            time.sleep(max(0.0, due - time.monotonic()))


def thread_times() -> dict[str, float]:
    """Processor time [s] of this process by group of threads; `total` includes threads that are not Python's."""
    times: dict[str, float] = dict.fromkeys(GROUPS, 0.0) | {"total": time.process_time()}
    for thread in threading.enumerate():
        assert thread.ident is not None, "an enumerated thread has started"
        group = {"MainThread": "states", "live view": "drawing"}.get(thread.name, "sending")
        times[group] += time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
    return times


def measure(player: Player, seconds: float) -> dict[str, float]:
    """Shares of one core [%] in the next `seconds`, by group."""
    before, frames, start = thread_times(), player.frames, time.monotonic()
    player.play(seconds)
    after, elapsed = thread_times(), time.monotonic() - start
    shares = {name: 100.0 * (after[name] - before[name]) / elapsed for name in (*GROUPS, "total")}
    return shares | {"frames": (player.frames - frames) / elapsed}


def open_browser(profile: Path) -> Browser:
    """A browser of low priority, because it renders in software and would delay the view on a machine of few cores.

    The priority belongs to a thread, and the processes that it starts inherit it.
    """

    def open_with_low_priority() -> Browser:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), BROWSER_NICENESS)
        return Browser(profile, WINDOW)

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(open_with_low_priority).result()


def measure_viewers(feed: LiveFeed, player: Player, viewers: list[int], seconds: float) -> dict[int, dict[str, float]]:
    """The shares by number of viewers, which increases."""
    found: dict[int, dict[str, float]] = {}
    with ExitStack() as stack:
        opened = 0
        for count in sorted(viewers):
            for _ in range(count - opened):
                folder = stack.enter_context(tempfile.TemporaryDirectory())
                browser = stack.enter_context(open_browser(Path(folder)))
                browser.open(feed.view.url)
                player.play(SETTLING_TIME_S)
                assert browser.execute_script(LOADED), "the page is not loaded"
            opened = count
            found[count] = measure(player, seconds)
    player.play(SETTLING_TIME_S)  # the connections of the closed pages end
    return found


def table(rows: list[dict[int, dict[str, float]]]) -> str:
    """The medians of all repeats as a table, with the least and the largest total."""
    lines = ["viewers   states  drawing  sending    total  frames/s  range of the total [% of one core]"]
    for count in rows[0]:
        medians = [float(np.median([row[count][name] for row in rows])) for name in (*GROUPS, "total", "frames")]
        totals = [row[count]["total"] for row in rows]
        shown = "  ".join(f"{value:7.2f}" for value in medians)
        lines.append(f"{count:7d}  {shown}     {min(totals):.2f} to {max(totals):.2f}")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of one measurement [s]")
    parser.add_argument("--viewers", type=int, nargs="+", default=[0, 1, 2], help="numbers of open pages")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--period", type=float, default=TICK_REPORT_PERIOD, help="time between two reports [s]")
    parser.add_argument("--json", action="store_true", help="print all values as JSON")
    chosen = parser.parse_args()
    reports = record_reports()
    feed = LiveFeed(ROBOT, open_demo_world().plant, PORT, Console(quiet=True), operate=lambda action, speed: "")
    proposal = Proposal(text="{}", finish_reason="stop", planner="recorded", constrained_by="none", timings={})
    feed.on_attempt(Attempt(proposal, Accepted(CONTRACT), 0.0))
    feed.view._panel._history.extend((0.001 * k, 50.0, 0.0) for k in range(MAX_HISTORY_POINTS))
    player, rows = Player(feed, reports, chosen.period), []
    for _ in range(chosen.repeats):
        rows.append(measure_viewers(feed, player, chosen.viewers, chosen.seconds))
        print(f"load {Path('/proc/loadavg').read_text().split()[0]}: {rows[-1]}", file=sys.stderr)
    feed.close()
    print(json.dumps(rows) if chosen.json else table(rows))


if __name__ == "__main__":
    main()
