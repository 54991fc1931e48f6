"""A replayable example of each failure class: scene, contract and seed, classified again from a new run."""

from __future__ import annotations

import itertools
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.verdict import Rejected
from dualbrain.control.control_loop import ControlLoopConfig, LoopInputs
from dualbrain.evaluation.analysis.failure_taxonomy import FAILURE_TAXONOMY, FailureEvidence, classify_failure
from dualbrain.evaluation.fault_injection.faults import Fault
from dualbrain.evaluation.fault_injection.trial import run_fault_trial
from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
from dualbrain.grounding.instruction.review import Refusal
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.planner.protocol import is_answer
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Outcome
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.runtime.inspection.dry_run import context_at_home
from dualbrain.runtime.planning.local_answer import answer_locally
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.simulation.world import contract_goals, make_world
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.safety.closed_loop import GRASP_PARAMETERS, PLACE_PARAMETERS

EXAMPLE_FILE = Path(__file__).with_name("failure_examples.toml")
SETTLE_TIME = 0.2
TIME_LIMIT = 60.0
MOVE_PARAMETERS = {"target": "blue_bowl", "speed": 0.4, "clearance": 0.2, "route": "direct", "wait": "none"}
PUSH_PARAMETERS = {"speed": 0.1, "clearance": 0.15, "wait": "none"}
SUCCESS = "no failure"


class FailureExample(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One example; the fields are described at the head of the file."""

    failure: str
    about: str
    scene: str
    robot: str = "panda"
    seed: int = 0
    noise: tuple[int, ...] = (0, 1)
    goal: tuple[str, str] = ("red_cube", "blue_bowl")
    gentle: bool = False
    skills: tuple[str, ...] = ()
    grasp: dict[str, Any] = {}
    place: dict[str, Any] = {}
    push: dict[str, Any] = {}
    guard: bool = True
    unchecked: bool = False
    hidden: str = ""
    interrupt_s: float = float("inf")
    answer: tuple[str, str] | None = None
    instruction: str = ""
    fault: tuple[str, str] | None = None
    cheap: bool = False

    @property
    def actions(self) -> list[dict[str, Any]]:
        """The actions of the contract."""
        parameters: dict[str, dict[str, Any]] = {
            "grasp": GRASP_PARAMETERS | self.grasp,
            "place": PLACE_PARAMETERS | self.place,
            "move_to": MOVE_PARAMETERS,
            "push": PUSH_PARAMETERS | self.push,
            "decline": {"reason": "I would rather not"},
        }
        return [{"skill": skill, "params": parameters[skill]} for skill in self.skills]


@cache
def failure_examples() -> tuple[FailureExample, ...]:
    """All examples, in the order of the classes."""
    content = tomllib.loads(EXAMPLE_FILE.read_text("utf-8"))
    return msgspec.convert(content["example"], tuple[FailureExample, ...])


def replay(example: FailureExample) -> tuple[str, Row]:
    """Run an example; the class that it has now, and what the robot and the monitor reported."""
    if example.fault is not None:
        evidence, success = _replay_fault(example), False
    elif example.instruction:
        evidence, success = _review_instruction(example), False
    elif example.answer is not None:
        evidence, success = _evidence_without_motion(example), False
    else:
        evidence, success = _replay_contract(example)
    found = SUCCESS if success else classify_failure(evidence)
    kinds = sorted(evidence.kinds)
    return found, {"outcome": evidence.outcome, "reason": evidence.reason, "kinds": kinds}


def _replay_contract(example: FailureExample) -> tuple[FailureEvidence, bool]:
    spec, model = open_scene(example.scene, example.robot), load_robot(example.robot)
    goal = PlacementGoal(*example.goal, gentle=example.gentle)
    others = frozenset(obj.name for obj in spec.objects if obj.name not in example.goal)
    noise = PerceptionNoise(hidden_objects=others if example.hidden == "all" else frozenset())
    rng = np.random.default_rng(example.noise)
    world = make_world(spec, model, goal=goal, perception=lambda plant: NoisyPerception(spec, noise, rng))
    limit = min(TIME_LIMIT, example.interrupt_s) / model.period
    ticks = itertools.count()  # not the clock of the simulator, which a reset of the engine sets back
    cell = SimulatedCell(
        model,
        world,
        config=ControlLoopConfig(guard=example.guard),
        inputs=LoopInputs(interrupted=lambda: next(ticks) >= limit),
        time_limit=TIME_LIMIT,
    )
    cell.executor.hold(SETTLE_TIME)
    contract, outcome, refusal = _execute(cell, example)
    judgement = cell.judgement()
    evidence = FailureEvidence(
        moved=outcome is not None and outcome.kind != "declined",
        on_task=contract is not None and contract_goals(contract) == PlacementGoal(*example.goal),
        declined=outcome is not None and outcome.kind == "declined",
        outcome=outcome.kind if outcome else "rejected",
        reason=outcome.reason if outcome else refusal,
        claimed=outcome is not None and outcome.kind == "succeeded",
        violations=judgement.violations,
        bad_physics=bool(world.monitor.measurements().physics_warnings),
    )
    return evidence, judgement.success


def _execute(cell: SimulatedCell, example: FailureExample) -> tuple[Contract | None, Outcome | None, str]:
    """The contract, its outcome and the refusal of the gate; without the gate every contract is executed."""
    if example.unchecked:
        actions = tuple(Action(one["skill"], one["params"]) for one in example.actions)
        contract = Contract("c-0001", Context(example.robot, ""), actions)
        return contract, cell.execute(contract), ""
    verdict = cell.check(cell.contract(example.actions))
    if isinstance(verdict, Rejected):
        return None, None, f"{verdict.stage} {verdict.pointer}: {verdict.hint}"
    return verdict.contract, cell.execute(verdict.contract), ""


def _evidence_without_motion(example: FailureExample) -> FailureEvidence:
    assert example.answer is not None
    return FailureEvidence(
        moved=False,
        on_task=False,
        declined=False,
        outcome="rejected",
        reason=example.answer[1],
        claimed=False,
        answered=is_answer(example.answer[1]),
    )


def _review_instruction(example: FailureExample) -> FailureEvidence:
    """The answer of the local layer to the words of an example, before any planner is asked."""
    context = context_at_home(
        open_robot_at_site(example.robot), scene_from_spec(open_scene(example.scene, example.robot))
    )
    answer = answer_locally(example.instruction, context, ScriptedPlanner([]))
    declined = isinstance(answer, Refusal)
    return FailureEvidence(
        moved=False,
        on_task=False,
        declined=declined,
        outcome="declined" if declined else "asked",
        reason=answer.reason if isinstance(answer, Refusal) else "",
        claimed=False,
    )


def _replay_fault(example: FailureExample) -> FailureEvidence:
    assert example.fault is not None
    report = run_fault_trial(
        Fault(*example.fault, "closing"), robot=example.robot, scene=example.scene, seed=example.seed
    )
    return FailureEvidence(
        moved=True,
        on_task=True,
        declined=False,
        outcome=report.outcome,
        reason=report.reason,
        claimed=report.outcome == "succeeded",
        violations=(*report.unsafe, *report.other),
    )


class FailureExamples:
    """Every failure class has an example that can be replayed."""

    name = "failure_examples"
    claim = "The example of each failure class still ends in that class, so that causes can be distinguished."

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit for each example."""
        del options
        return [WorkUnit(one.failure, {"index": index}) for index, one in enumerate(failure_examples())]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Replay one example."""
        example = failure_examples()[parameters["index"]]
        found, evidence = replay(example)
        return {"failure": example.failure, "about": example.about, "scene": example.scene, "found": found, **evidence}

    def summarize_row(self, row: Row) -> str:
        """The class that was found, and the reason."""
        return f"{row['found']}: {row['outcome']}: {row['reason']} {', '.join(row['kinds'])}"

    def report(self, rows: list[Row]) -> list[str]:
        """Every class with its definition and its example."""
        by_name = {row["failure"]: row for row in rows}
        again = sum(row["found"] == row["failure"] for row in rows)
        lines = [f"{again} of {len(rows)} examples end in their class again.", ""]
        cells = [(one.name, one.definition, *_example_cells(by_name.get(one.name))) for one in FAILURE_TAXONOMY]
        return lines + markdown_table(("class", "definition", "example", "scene", "the robot reports", "again"), cells)


def _example_cells(row: Row | None) -> tuple[str, str, str, str]:
    if row is None:
        return "no example is known", "", "", ""
    reported = f"{row['outcome']}: {row['reason']}" + (f"; monitor: {', '.join(row['kinds'])}" if row["kinds"] else "")
    return row["about"], row["scene"], reported, "yes" if row["found"] == row["failure"] else f"no: {row['found']}"
