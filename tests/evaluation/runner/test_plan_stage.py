"""The plan stage: one line for each case, also for one whose instruction the local check declines."""

import itertools

import msgspec

from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.evaluation.protocol.suite import load_suite
from dualbrain.evaluation.runner import worker
from dualbrain.evaluation.runner.runner import Runner
from dualbrain.evaluation.runner.worker_pool import SerialPool


class CachedPlanner:
    """A planner whose answers to the requests of the Panda are cached."""

    name = "cached"
    n_requests = 0

    def is_cached(self, request):
        return request.robot == "panda"

    def propose_uncached(self, requests):
        raise AssertionError(requests)


class Planners:
    def __init__(self, *_):
        pass

    def get(self, method, robot):
        return CachedPlanner()

    def close(self):
        pass


def test_a_case_that_asks_no_planner_has_a_line_and_the_stage_is_complete(tmp_path, monkeypatch):
    """The hand of the UR5e would break these glasses, so that no planner is asked; that of the Panda holds them."""
    monkeypatch.setattr(worker, "PlannerFactory", Planners)
    suite = load_suite("embodiments")
    tasks = tuple(task for task in suite.tasks if (task.family, task.level) == ("fragile_transfer", "I"))
    suite = msgspec.structs.replace(
        suite, tasks=tasks, robots=("ur5e", "panda"), methods=("B3",), first=40_400, seeds=2, runs=2
    )
    runner = Runner(suite, tmp_path, clock=itertools.count().__next__, on_progress=lambda _: None)
    config = worker.WorkerConfig(
        suite=suite,
        out=tmp_path,
        sources=PlannerSources(tmp_path, tmp_path),
        clock=itertools.count().__next__,
        epsilon={},
    )
    assert runner.run_stage("plan", SerialPool(config.make_worker()))
    lines = list(runner.read_lines("plan"))
    assert len({line["key"] for line in lines}) == sum(unit.n_episodes for unit in runner.units("plan")) == 4
    assert all(line["asked"] == 0 for line in lines)
