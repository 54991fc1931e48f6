"""Time lost to intervention: the same contract again, unfiltered, in a scene without obstacles."""

from __future__ import annotations

from dataclasses import replace

import msgspec

from dualbrain.evaluation.episodes.case_runner import Clock, EpisodeResources, EpisodeRun, run_case
from dualbrain.evaluation.episodes.scoring import contract_of
from dualbrain.evaluation.protocol.case import Case
from dualbrain.evaluation.protocol.method import Method
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.simulation.scenes.scene_spec import SceneSpec

BARE_METHOD = Method(
    name="bare", description="the contract alone, in the bare scene, unfiltered", gate="syntax", guard=False
)


def bare_scene(spec: SceneSpec, named: set[str]) -> SceneSpec:
    """`spec` with only the objects that the contract names: no neighbours, no person."""
    return msgspec.structs.replace(spec, objects=tuple(one for one in spec.objects if one.name in named), mover=None)


def seconds_lost(case: Case, run: EpisodeRun, clock: Clock) -> float | None:
    """Motion time [s] of `run` beyond that of its contract in the bare scene; None unless both succeeded.

    Success is the robot's own verdict here; a table also requires success on ground truth. The goal of the case is not
    judged in the bare scene, which need not contain its objects.
    """
    episode = run.episode
    if episode.contract is None or episode.outcome.kind != "succeeded":
        return None
    contract = contract_of(episode)
    named = {str(value) for action in contract.action_sequence for value in action.params.values()}
    bare_case = replace(case, spec=bare_scene(case.spec, named), goal=None)
    planner = FixedContractPlanner("bare", msgspec.json.encode(contract))
    bare_outcome = run_case(
        bare_case, BARE_METHOD, EpisodeResources(id="bare", planner=planner, clock=clock, planning_time=0.2)
    ).episode.outcome
    return episode.outcome.duration - bare_outcome.duration if bare_outcome.kind == "succeeded" else None
