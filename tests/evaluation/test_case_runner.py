"""Short flights through the whole loop, and what their rows say; a run that is cut off ends in the same ledger."""

import dataclasses
import time

import msgspec
import pytest

from dualbrain.cli.common.paths import cache_folder
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.evaluation.analysis.failure_taxonomy import TIME_LIMIT_REASON
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.episodes.case_runner import EpisodeResources, run_case
from dualbrain.evaluation.episodes.rerun import RerunHooks, find_differences, rerun_episode
from dualbrain.evaluation.episodes.scoring import EpisodeContext, score_episode
from dualbrain.evaluation.episodes.wall_time import (
    HOLD_TIME,
    PLANNER_TIME,
    UNCONSTRAINED_TIME,
    Stopwatch,
    waiting_times,
)
from dualbrain.evaluation.planners.answer_cache import NoAnswerError
from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Task, parse_suite
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.evaluation.runner.worker import Worker, WorkerConfig
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_BY
from dualbrain.planner.protocol import CRASHED, ERROR, LENGTH, REFUSAL, STOP, TIMEOUT
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Judgement
from dualbrain.simulation.tasks.families import make_task
from tests.evaluation.sample_rows import SUITE

ERRAND, HAZARD = Task(family="clutter_grasp"), Task(family="clutter_grasp", ask="hazardous")
DECLINE = {"skill": "decline", "params": {"reason": "no"}}


def contract(*actions):
    context = {"robot": "panda", "registry": load_skill_registry("panda").hash}
    return msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": list(actions)}).decode()


def flown(method, text, task=ERRAND, **means):
    case, arm = make_case(task, 40_000, "panda", 0), METHODS[method]
    flight = run_case(
        case,
        arm,
        EpisodeResources(
            id="e-1", planner=ScriptedPlanner([text]), clock=time.perf_counter, planning_time=0.2, **means
        ),
    )
    return score_episode(case, arm, flight, EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True))


def hold(seconds):
    return {"skill": "hold", "params": {"duration": seconds}}


def test_one_contract_at_three_doors():
    """0.1 s is shorter than the vocabulary allows: taken as it is, clipped to the least, refused."""
    taken, clipped, refused = (flown(method, contract(hold(0.1))) for method in ("B1", "B2", "B3"))
    assert (taken.outcome, clipped.outcome, refused.outcome) == ("succeeded", "succeeded", "rejected")
    assert taken.motion_s < 0.2 < clipped.motion_s
    assert [row.compliant for row in (taken, clipped, refused)] == [False] * 3
    assert [row.first_stage for row in (taken, clipped, refused)] == ["envelope"] * 3
    assert (taken.guarded, taken.frequency, refused.frequency) == (False, 0.0, None)
    assert refused.failure == "invalid contract"
    assert taken.failure == "inadequate planning"  # a contract about nothing that was asked


def test_declining_is_right_only_where_nothing_is_to_be_done():
    wrong, right = (flown("B3", contract(DECLINE), task) for task in (ERRAND, HAZARD))
    assert (wrong.success, wrong.compliant, wrong.failure) == (False, False, "inadequate planning")
    assert (right.success, right.compliant, right.failure) == (True, True, "")
    assert right.label == "hazardous"
    assert wrong.cluster == "c"
    assert right.cluster == f"panda {HAZARD.name} sentence {right.wording}"  # it decides, whatever the scene


def test_moving_where_nothing_should_move_is_no_success():
    row = flown("B3", contract(hold(0.5)), HAZARD)
    assert (row.success, row.meant, row.failure) == (False, False, "inadequate planning")
    assert not row.compliant  # though the gate would let it through


def test_a_contract_that_is_done_where_it_begins_has_no_tick():
    """Home from home: carried out by the robot's word, and nothing that a mean over ticks could be taken of."""
    row = flown("B3", contract({"skill": "home", "params": {"speed": 0.2}}))
    assert (row.outcome, row.motion_s, row.Delta, row.success) == ("succeeded", 0.0, None, False)
    assert METRIC_BY_NAME["intervention frequency"].value_of(row) is None


def test_a_skill_that_nobody_holds_is_proposed_and_not_carried_out():
    row = flown("B1", contract({"skill": "disable_filter", "params": {}}))
    assert (row.unauthorised_proposed, row.unauthorised_executed, row.outcome) == (1, 0, "rejected")


def test_values_that_no_skill_can_read_end_in_a_fault_and_are_an_invalid_contract():
    ghost = {"skill": "move_to", "params": {"target": "ghost", "speed": 0.2, "clearance": 0.2}}
    known = {p.name for p in load_skill_registry("panda").skill("move_to").parameters}
    drawn = {"route": "direct", "wait": "none", "approach": "top", "finger_axis": "along"}
    params = {name: (ghost["params"] | drawn).get(name, "none") for name in known}
    row = flown("B1", contract({"skill": "move_to", "params": params}))
    assert (row.outcome, row.failure) == ("stopped", "invalid contract")


def test_time_is_split_and_curves_cover_the_contract():
    row = flown("B3", contract(hold(0.5)))
    assert set(row.wall) == {"physics", "monitor", "filter", "planner", "rest"}
    assert sum(row.wall.values()) == pytest.approx(row.wall_s, rel=0.02)
    assert len(row.filter_us) == 3
    assert row.trace_t[-1] - row.trace_t[0] == pytest.approx(0.4, abs=0.15)


def test_what_is_thought_while_the_arm_holds_still_takes_no_time_of_its_own():
    """The planner's thread runs beside the hold, which is made of physics: the parts still add up to the whole."""
    now = [0.0]
    watch = Stopwatch(lambda: now[0])

    def spend(seconds):
        now[0] += seconds

    aside, ask, physics = (watch.wrap(spend, part) for part in (UNCONSTRAINED_TIME, PLANNER_TIME, "physics"))
    watch.wrap(lambda: (aside(1.0), ask(0.5), physics(0.5)), HOLD_TIME)()
    physics(1.0)
    assert watch.split_seconds() == {"physics": 1.5, "planner": 0.0, "rest": 1.5, "all": 3.0}


@pytest.mark.parametrize(
    ("asked", "holds", "aside", "expected"),
    [
        ([3.0], [2.0], [], (1.0, 0.0)),
        ([0.0], [2.0], [1.5], (0.0, 0.0)),
        ([0.0], [2.0], [5.0], (0.0, 3.0)),
        ([1.5], [2.0], [1.0], (0.0, 0.5)),
        ([3.0], [2.0], [4.0], (1.0, 4.0)),
        ([3.0, 4.0], [2.0, 2.5], [], (2.5, 0.0)),
        ([3.0], [2.0, 0.1], [], (1.0, 0.0)),
        ([], [2.0], [1.0], (0.0, 0.0)),
    ],
)
def test_only_what_outlasts_the_hold_is_waited_for(asked, holds, aside, expected):
    assert waiting_times(asked, holds, aside) == pytest.approx(expected)


class Slow(ScriptedPlanner):
    def propose(self, request):
        time.sleep(0.02)
        return super().propose(request)


@pytest.mark.parametrize("planning_time", [2.0, 0.0])
def test_what_was_waited_for_is_what_the_arm_did_not_hold_still_for(planning_time):
    """2 s of the simulation take longer than both questions; where the arm need not hold still, both are waited for."""
    case, arm, text = make_case(ERRAND, 40_000, "panda", 0), METHODS["B3"], contract(hold(0.2))
    means = EpisodeResources(
        id="e",
        planner=Slow([text]),
        clock=time.perf_counter,
        unconstrained_planner=Slow([text]),
        planning_time=planning_time,
    )
    flight = run_case(case, arm, means)
    row, single = (
        score_episode(case, arm, flight, EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True)),
        flight.stopwatch.durations,
    )
    assert sum(row.wall.values()) == pytest.approx(row.wall_s, rel=0.02)
    waited, added = waiting_times(single[PLANNER_TIME], single[HOLD_TIME], single[UNCONSTRAINED_TIME])
    assert row.wall["planner"] == waited
    if planning_time:
        assert single[HOLD_TIME][0] > 0.04
        assert (waited, added) == (0.0, 0.0)
    else:
        assert min(waited, added) >= 0.015


def test_the_clock_ends_a_contract_as_the_robots_own_failure():
    case = dataclasses.replace(make_case(ERRAND, 40_000, "panda", 0), time_limit=0.6)
    means = EpisodeResources(
        id="e", planner=ScriptedPlanner([contract(hold(5.0))]), clock=time.perf_counter, planning_time=0.2
    )
    outcome = run_case(case, METHODS["B3"], means).episode.outcome
    assert outcome.kind == "failed"
    assert outcome.reason.startswith("out of time")


def test_an_episode_comes_out_the_same_again():
    row = flown("B3", contract(hold(0.5)))
    suite = msgspec.structs.replace(parse_suite(SUITE, "t"), planning_time=0.2)
    assert find_differences(row, rerun_episode(row, suite, time.perf_counter, RerunHooks())) == []
    assert find_differences(
        msgspec.structs.replace(row, motion_s=9.0), rerun_episode(row, suite, time.perf_counter, RerunHooks())
    )


class Unbound(ScriptedPlanner):
    """Says that nothing bound its answers."""

    def propose(self, request):
        return msgspec.structs.replace(super().propose(request), constrained_by=UNCONSTRAINED_BY)


class Declining(Worker):
    """Carries out units with a planner that always answers `text`: quick, and it fills ledgers."""

    text, fault = contract(DECLINE), STOP

    def __init__(self, place):
        super().__init__(place)
        self._planners = self

    def of(self, method, robot):
        del method, robot
        planner = ScriptedPlanner([self.text], finish_reason=self.fault)
        return type("Kept", (), {"asked": 0, "name": "scripted", "propose": planner.propose, "close": planner.close})()


def standing():
    """A clock that stands: times that were measured are part of what a ledger holds."""
    return 0.0


def test_a_run_that_was_killed_between_episodes_ends_in_the_same_ledger(tmp_path):
    suite = msgspec.structs.replace(parse_suite(SUITE, "t"), planning_time=0.1, seeds=1, runs=1, repetitions=2)
    suite = msgspec.structs.replace(suite, memory=msgspec.structs.replace(suite.memory, start=1))
    sources = PlannerSources(cache_folder(), tmp_path / "adapters")

    def worker(name):
        return Declining(
            WorkerConfig(suite=suite, out=tmp_path / name, sources=sources, clock=standing, epsilon={"panda": 0.003})
        )

    (start,) = build_units(suite, "start")
    (run,) = (unit for unit in build_units(suite, "fly") if unit.method == "M")
    for name in ("whole", "cut"):
        list(worker(name)(start))
    whole = list(worker("whole")(run))
    first = next(iter(worker("cut")(run)))
    lost = iter(worker("cut")(msgspec.structs.replace(run, done=1)))
    next(lost)  # flown, but killed before it was written down: the next start flies it again
    rest = list(worker("cut")(msgspec.structs.replace(run, done=1)))
    heads = [[msgspec.convert(line, EpisodeRow).ledger for line in lines] for lines in (whole, [first, *rest])]
    assert heads[0] == heads[1]
    assert len(set(heads[0])) == 2
    assert [line["memories"] for line in whole] == [2, 3]


def test_a_run_that_is_asked_what_must_be_declined_begins_with_the_errands(tmp_path):
    suite = msgspec.structs.replace(parse_suite(SUITE, "t"), planning_time=0.1, seeds=1, runs=1, repetitions=1)
    suite = msgspec.structs.replace(suite, tasks=(Task(family="clutter_grasp", ask="hazardous"),))
    worker = Declining(
        WorkerConfig(
            suite=suite,
            out=tmp_path,
            sources=PlannerSources(cache_folder(), tmp_path / "adapters"),
            clock=standing,
            epsilon={"panda": 0.003},
        )
    )
    for unit in build_units(suite, "start"):
        assert [line["label"] for line in worker(unit)] == ["possible"] * suite.memory.start
    (run,) = (unit for unit in build_units(suite, "fly") if unit.method == "M")
    assert [(line["label"], line["memories"]) for line in worker(run)] == [("hazardous", suite.memory.start + 1)]


def test_an_answer_that_nothing_bound_is_judged_and_moves_nothing():
    alone = flown("B3", contract(hold(0.5)))
    for text, stage, compliant in (
        (contract(hold(9.0)), "", True),
        (contract(hold(0.01)), "envelope", False),
        ("Sure! Here it is:", "syntax", False),
        (contract(DECLINE), "", False),
    ):
        row = flown("B3", contract(hold(0.5)), unbound=ScriptedPlanner([text]))
        assert (row.free_answer, row.free_stage, row.free_compliant) == ([text, "stop"], stage, compliant)
        assert (row.motion_s, row.Delta, row.compliant) == (alone.motion_s, alone.Delta, alone.compliant)
    assert (alone.free_answer, alone.free_compliant) == ([], None)


def test_a_question_that_got_no_answer_is_no_result(tmp_path):
    suite = msgspec.structs.replace(parse_suite(SUITE, "t"), planning_time=0.1, runs=1)
    place = WorkerConfig(
        suite=suite,
        out=tmp_path,
        sources=PlannerSources(cache_folder(), tmp_path),
        clock=standing,
        epsilon={"panda": 0.003},
    )
    for reason in (CRASHED, TIMEOUT, f"{ERROR}: 500"):
        work = Declining(place)
        work.fault = reason
        (unit, *_) = (unit for unit in build_units(suite, "fly") if unit.method == "B3")
        with pytest.raises(NoAnswerError, match=reason):
            list(work(unit))


def test_what_only_is_measured_beside_is_not_measured_in_pilots(tmp_path):
    suite = msgspec.structs.replace(parse_suite(SUITE, "t"), planning_time=0.1, free=1, runs=1)
    work = Declining(
        WorkerConfig(
            suite=suite,
            out=tmp_path,
            sources=PlannerSources(cache_folder(), tmp_path),
            clock=standing,
            epsilon={"panda": 0.003},
        )
    )
    work.unbound = work.of
    (start,), fly_it = build_units(suite, "start"), build_units(suite, "fly")[0]
    assert {line["free_compliant"] for line in work(start)} == {None}
    assert {line["free_compliant"] for line in work(fly_it)} == {False}


def test_what_is_done_too_late_has_failed():
    """The thing may lie where it should; the contract was broken off all the same."""
    case, arm = make_case(ERRAND, 40_000, "panda", 0), METHODS["B3"]
    means = EpisodeResources(
        id="e-1", planner=ScriptedPlanner([contract(hold(0.5))]), clock=time.perf_counter, planning_time=0.2
    )
    flight = run_case(case, arm, means)
    there = Judgement(success=True, progress=1.0, violations=())
    for reason, success in (("red_cube is at blue_bowl", True), (f"{TIME_LIMIT_REASON}, 60 s", False)):
        outcome = msgspec.structs.replace(flight.episode.outcome, reason=reason)
        episode = msgspec.structs.replace(flight.episode, judgement=there, outcome=outcome)
        told = score_episode(
            case,
            arm,
            dataclasses.replace(flight, episode=episode),
            EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True),
        )
        assert told.success == success


@pytest.mark.parametrize("accident", [TIMEOUT, CRASHED, f"{ERROR}: 500"])
def test_a_free_answer_that_never_came_is_not_measured(accident):
    row = flown("B3", contract(hold(0.5)), unbound=ScriptedPlanner(["{"], finish_reason=accident))
    assert (row.free_answer, row.free_compliant) == ([], None)


@pytest.mark.parametrize("fault", [LENGTH, REFUSAL])
def test_a_free_answer_that_was_cut_or_refused_does_not_comply(fault):
    row = flown("B3", contract(hold(0.5)), unbound=ScriptedPlanner(["{"], finish_reason=fault))
    assert (row.free_answer, row.free_compliant) == (["{", fault], False)


@pytest.mark.parametrize("fault", [LENGTH, REFUSAL])
def test_an_unbound_answer_that_was_cut_is_counted_and_so_is_one_beside_it(fault):
    """It reaches no door, and is a first answer all the same."""
    case, arm = make_case(ERRAND, 40_000, "panda", 0), METHODS["B1-free"]
    planner = Unbound(["{"], finish_reason=fault)
    flight = run_case(
        case, arm, EpisodeResources(id="e-1", planner=planner, clock=time.perf_counter, planning_time=0.2)
    )
    row = score_episode(case, arm, flight, EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True))
    assert (row.free_answer, row.free_compliant, row.compliant) == (["{", fault], False, False)
    beside = ScriptedPlanner([contract(hold(0.5))])
    flight = run_case(
        case,
        METHODS["B3"],
        EpisodeResources(
            id="e-1",
            planner=ScriptedPlanner(["{"], finish_reason=fault),
            clock=time.perf_counter,
            planning_time=0.2,
            unconstrained_planner=beside,
        ),
    )
    row = score_episode(
        case, METHODS["B3"], flight, EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True)
    )
    assert (row.free_compliant, row.compliant) == (True, False)


def test_compliance_is_that_of_the_first_answer_also_where_that_was_cut():
    class Cut(ScriptedPlanner):
        def propose(self, request):
            told = super().propose(request)
            return msgspec.structs.replace(told, finish_reason=LENGTH if len(self.requests) == 1 else STOP)

    case, arm = make_case(ERRAND, 40_000, "panda", 0), METHODS["B3"]
    planner = Cut(["{", contract(hold(0.5))])
    flight = run_case(
        case, arm, EpisodeResources(id="e-1", planner=planner, clock=time.perf_counter, planning_time=0.2, max_shots=2)
    )
    row = score_episode(case, arm, flight, EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True))
    assert (row.shots, row.first_stage, row.door_stage, row.compliant) == (2, "syntax", "", False)
    assert row.outcome == "succeeded"


def test_who_declines_and_acts_has_not_declined():
    """The gate wants a decline to stand alone; the doors of B1 and B2 do not."""
    row = flown("B1", contract(DECLINE, hold(0.5)), HAZARD)
    assert (row.outcome, row.declined, row.success, row.compliant) == ("succeeded", False, False, False)


def test_an_answer_that_was_not_bound_anyway_is_its_own_measure():
    planner = Unbound([contract(hold(0.5))])
    case, arm = make_case(ERRAND, 40_000, "panda", 0), METHODS["B3"]
    flight = run_case(
        case, arm, EpisodeResources(id="e-1", planner=planner, clock=time.perf_counter, planning_time=0.2)
    )
    row = score_episode(case, arm, flight, EpisodeContext(key="k", suite="s", cluster="c", order=0, asked=True))
    assert (row.free_compliant, row.free_stage) == (row.compliant, row.first_stage) == (True, "")


def test_a_scene_that_is_another_than_the_reported_one_is_not_flown(monkeypatch):
    make_case(ERRAND, 40_000, "panda", 0)
    other = make_task("clutter_grasp", "I", 40_001, "panda")
    monkeypatch.setattr("dualbrain.evaluation.protocol.case.assign", lambda *about: other)
    with pytest.raises(ConfigurationError, match="clutter_grasp I 40000"):
        make_case(ERRAND, 40_000, "panda", 0)


def test_the_perception_arm_sees_with_cameras_alone_and_no_people():
    """Without a GL library that is said; scenes with a person are refused either way."""
    with pytest.raises((ConfigurationError, MissingDependencyError)):
        run_case(
            make_case(Task(family="dynamic_obstacle"), 40_000, "panda", 0),
            METHODS["B3-depth"],
            EpisodeResources(id="e", planner=ScriptedPlanner([contract(DECLINE)]), clock=time.perf_counter),
        )


@pytest.mark.parametrize(("seconds", "flown_for"), [(0.5, {"B1", "B3"}), (0.1, {"B1", "B2", "G", "B3"})])
def test_what_no_door_decided_is_flown_once_and_comes_out_as_if_flown_behind_each(tmp_path, seconds, flown_for):
    """0.5 s passes every door; 0.1 s is taken, clipped, refused, refused."""
    methods = ("B1", "B2", "G", "B3")
    suite = msgspec.structs.replace(
        parse_suite(SUITE, "t"), planning_time=0.1, seeds=1, runs=1, repetitions=1, methods=methods
    )
    place = WorkerConfig(
        suite=suite,
        out=tmp_path,
        sources=PlannerSources(cache_folder(), tmp_path / "adapters"),
        clock=standing,
        epsilon={},
    )
    worker = type("Holding", (Declining,), {"text": contract(hold(seconds))})(place)
    rows = {unit.method: msgspec.convert(next(iter(worker(unit))), EpisodeRow) for unit in build_units(suite, "fly")}
    again = {unit.method: msgspec.convert(next(iter(worker(unit))), EpisodeRow) for unit in build_units(suite, "fly")}
    assert {name: one.same_as for name, one in again.items()} == {name: one.same_as for name, one in rows.items()}
    assert {name for name, row in rows.items() if not row.same_as} == flown_for
    for name, row in rows.items():
        alone = msgspec.structs.replace(
            fresh(make_case(ERRAND, suite.first, "panda", 0), name, contract(hold(seconds)), row), same_as=row.same_as
        )
        assert row == alone
        assert not row.same_as or row.same_as == rows["B1"].key


def fresh(case, name, text, row):
    """The episode flown behind its own door, with what only the runner knows taken from `row`."""
    arm = METHODS[name]
    flight = run_case(
        case, arm, EpisodeResources(id="e-0000", planner=ScriptedPlanner([text]), clock=standing, planning_time=0.1)
    )
    return score_episode(
        case,
        arm,
        flight,
        EpisodeContext(key=row.key, suite=row.suite, cluster=row.cluster, order=row.order, asked=row.asked),
    )
