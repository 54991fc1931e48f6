"""The live view gets words, signs and the plan from snapshots, reports and events of a run."""

from collections.abc import Iterator

import msgspec
import pytest
from rich.console import Console

from dualbrain.cli.run.live_feed import LiveFeed
from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.gatekeeper.protocol.messages import TickReport
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.records import Attempt, Proposal
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.visualization.live.operator.operator_status import OperatorState, describe_situation
from dualbrain.visualization.live.view_state import ViewState
from tests.visualization.conftest import scene

PANDA = load_robot("panda")
REPORT = TickReport(
    t=1.0,
    scene=scene(),
    q=tuple(PANDA.home),
    opening=0.03,
    u=(0.05,) * 7,
    u_nom=(0.1,) * 7,
    delta=0.02,
    h_min=0.01,
    status="MODIFIED",
    barriers=("obstacle",),
    pairs=(("hand", "forearm", 0.01),),
    skill="place",
    phase="carry",
    in_contract=True,
    order="NONE",
    check="",
)
CONTRACT = Contract(
    "c-0001",
    Context("panda", "3fa9c1d2"),
    (Action("grasp", {"object": "red_cube"}), Action("place", {"destination": "bowl"})),
)
PROPOSAL = Proposal(text="{}", finish_reason="stop", planner="p", constrained_by="none", timings={})
ACCEPTED = Attempt(PROPOSAL, Accepted(CONTRACT), 1e-5)
REJECTED = Attempt(PROPOSAL, Rejected(stage="syntax", pointer="/", got="x", allowed="y", hint=""), 1e-5)


@pytest.fixture
def feed() -> Iterator[LiveFeed]:
    plant = make_plant(open_scene("8", "panda"), PANDA)
    made = LiveFeed(PANDA, plant, 18195, Console(quiet=True), instruction="put the red cube in the bowl")
    yield made
    made.view.close()


def shown(feed: LiveFeed) -> ViewState:
    assert feed.view._latest is not None
    return feed.view._latest


def test_a_report_is_drawn_with_its_words_and_signs(feed: LiveFeed) -> None:
    feed.on_tick_report(REPORT)
    state = shown(feed)
    assert describe_situation(state.situation).state is OperatorState.GIVING_WAY
    assert state.limiting_links == {"hand"}
    assert state.ghost


def test_the_plan_is_that_of_the_accepted_contract_and_follows_its_steps(feed: LiveFeed) -> None:
    feed.on_attempt(REJECTED)
    feed.on_tick_report(REPORT)
    assert shown(feed).plan == ()
    feed.on_attempt(ACCEPTED)
    feed.on_tick_report(msgspec.structs.replace(REPORT, t=1.1))
    assert [step.is_current for step in shown(feed).plan] == [True, False]
    feed.on_event(Event(1.2, "action", "place", {"index": 1}))
    feed.on_tick_report(msgspec.structs.replace(REPORT, t=1.2))
    assert [step.is_done for step in shown(feed).plan] == [True, False]
    feed.on_event(Event(1.3, "action", "place: done", {"status": "done"}))
    feed.on_tick_report(msgspec.structs.replace(REPORT, t=1.3))
    assert all(step.is_done for step in shown(feed).plan)


def test_reports_faster_than_the_frames_are_counted_but_not_drawn(feed: LiveFeed) -> None:
    feed.on_tick_report(REPORT)
    first = shown(feed)
    feed.on_tick_report(msgspec.structs.replace(REPORT, t=1.02, delta=0.04))
    assert shown(feed) is first
    feed.on_tick_report(msgspec.structs.replace(REPORT, t=1.2, delta=0.03))
    assert shown(feed).numbers["Delta"] == pytest.approx(0.03)


def test_reports_of_a_gatekeeper_are_periodic_until_it_ends(feed: LiveFeed) -> None:
    feed.end_reports()
    feed.on_tick_report(msgspec.structs.replace(REPORT, in_contract=False))
    assert shown(feed).is_periodic
    feed.end_reports()
    assert (shown(feed).t, shown(feed).is_periodic) == (REPORT.t, False)


def test_a_flight_log_passes_each_attempt_on() -> None:
    seen: list[Attempt] = []
    FlightLog(Trace(7), None, None, seen.append).attempt(0.0, ACCEPTED)
    assert seen == [ACCEPTED]
