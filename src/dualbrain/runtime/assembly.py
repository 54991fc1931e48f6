"""Assembly of one simulated robot: plant, world, filter, control loop and executor."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Verdict
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs, LoopObserver, WorldInterface
from dualbrain.control.executor import Grants
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.grounding.outcome.instruction_truth import make_instruction_judge
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.records import Judgement, Outcome
from dualbrain.robots.interface import RobotInterface
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import Goal, PerceptionModel, SimulatedWorld, make_world
from dualbrain.skills.registry import skill_registry


@dataclass(frozen=True, slots=True, kw_only=True)
class CellOptions:
    """Options of a simulated cell; every default is that of `dualbrain run`.

    `goal`: goal that ground truth is judged by; None: the goals of the contract itself. `seed`: randomness of the
    perception. `perception`: makes the perception model of a plant. `visuals`: load meshes for rendering. `pace(now)`
    may delay each period of the simulation. `permitted_skills`: the monitor reports every other skill that begins.
    `configuration`: initial joint position [rad] and gripper opening [m], None for open. `instruction`: the words that
    ground truth is judged by, beside a `goal`.
    """

    goal: Goal | None = None
    seed: int = 0
    perception: Callable[[Plant], PerceptionModel] | None = None
    visuals: bool = False
    pace: Callable[[float], None] | None = None
    permitted_skills: frozenset[str] | None = None
    configuration: tuple[Any, float | None] | None = None
    instruction: str = ""


class CellWorld(WorldInterface, Protocol):
    """A simulated world with its plant and, if it has any, its judges."""

    @property
    def plant(self) -> Plant:
        """The simulated robot in its scene."""
        ...

    @property
    def perception(self) -> PerceptionModel:
        """How the robot perceives the plant."""
        ...

    def start_contract(self, contract: Contract) -> None:
        """Record the start of an accepted contract."""
        ...

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Set the phase of the running skill."""
        ...

    def judgement(self) -> Judgement:
        """Success, progress and violations on ground truth."""
        ...


class SimulatedCell:
    """One simulated robot in one scene, with everything that executes contracts on it."""

    def __init__(
        self,
        robot_model: RobotModel,
        world: CellWorld,
        *,
        safety: SafetyFilter | None = None,
        log: FlightLog | None = None,
        config: ControlLoopConfig | None = None,
        observer: LoopObserver | None = None,
        inputs: LoopInputs | None = None,
        time_limit: float = float("inf"),
        robot: RobotInterface | None = None,
        environment: WorldInterface | None = None,
    ) -> None:
        """Connect the parts of a cell; `SimulatedCell.make` makes them from a robot and a scene.

        `safety` is the filter of `robot_model`, by default with its `operating_config` and without a site file;
        `log` gets ticks and events. `config`, `observer` and `inputs` are those of the control loop. A contract
        that `inputs` interrupts when the robot's clock shows `time_limit` [s] or more has failed. `robot` and
        `environment` replace the plant and the world for the control loop. The world follows the phases of the
        control loop in any case, before the callback of `observer`.

        Raises:
            ConfigurationError: the filter cannot be made for `robot_model` (see `SafetyFilter`).
        """
        outer = observer or LoopObserver()
        self.robot_model, self.world, self.plant = robot_model, world, world.plant
        self.safety = safety or SafetyFilter(robot_model, operating_config(robot_model))
        self.log = log or FlightLog(Trace(robot_model.n, robot_model.nq))

        def on_phase(phase: str, roles: dict[str, str | None]) -> None:
            world.set_phase(phase, roles)
            if outer.on_phase:
                outer.on_phase(phase, roles)

        self.loop = ControlLoop(
            robot_model,
            robot or self.plant,
            environment or world,
            self.safety,
            self.log,
            config or ControlLoopConfig(),
            replace(outer, on_phase=on_phase),
            inputs or LoopInputs(),
        )
        self.executor = ContractExecutor(self.loop, time_limit=time_limit)

    @classmethod
    def make(
        cls,
        robot: str | RobotModel = "panda",
        scene: str | SceneSpec = "0",
        options: CellOptions = CellOptions(),
        *,
        guard: bool = True,
        on_event: Callable[[Event], None] | None = None,
    ) -> Self:
        """A cell of a `robot` (name or model) in a `scene` (number, FAMILY:SEED, file or specification).

        `guard` False writes nominal controls unfiltered. `on_event` gets every event of the log.
        Raises `UnknownNameError` and `ConfigurationError`.
        """
        model = load_robot(robot) if isinstance(robot, str) else robot
        spec = open_scene(scene, model.name) if isinstance(scene, str) else scene
        trace = Trace(model.n, model.nq)
        log = FlightLog(trace, None, on_event) if on_event else FlightLog(trace)
        return cls(model, open_world(spec, model, options), log=log, config=ControlLoopConfig(guard=guard))

    def gate(self, grants: Grants | None = None) -> Gate:
        """The gate in front of the robot; by default the planner may call every skill."""
        return self.executor.gate(planner_grants(skill_registry(self.robot_model)) if grants is None else grants)

    def check(self, contract: bytes | str | dict[str, Any]) -> Verdict:
        """The gate's verdict on a contract (JSON text or the decoded object) in the current scene."""
        data = contract if isinstance(contract, bytes) else _encoded(contract)
        names, now = scene_names(self.executor.scene), self.executor.state.stamp
        return self.gate().check(data, names=names, principal=PLANNER, now=now)

    def contract(self, actions: list[dict[str, Any]], contract_id: str = "c-0001") -> dict[str, Any]:
        """A contract for this robot with `actions`, each {"skill": NAME, "params": {...}}."""
        registry = skill_registry(self.robot_model)
        context = {"robot": registry.robot, "registry": registry.hash}
        return {"id": contract_id, "context": context, "action_sequence": actions}

    def execute(self, contract: Contract) -> Outcome:
        """Execute an accepted contract; `judgement` then returns its result on ground truth."""
        self.world.start_contract(contract)
        return self.executor.execute(contract)

    def judgement(self) -> Judgement:
        """Success, progress and violations on the simulator's ground truth."""
        return self.world.judgement()

    def close(self) -> None:
        """Stop the robot and release the perception model."""
        self.plant.stop()
        self.world.perception.close()

    def __enter__(self) -> Self:
        """The cell itself."""
        return self

    def __exit__(self, *details: object) -> None:
        """Close the cell."""
        self.close()


def open_world(spec: SceneSpec, robot_model: RobotModel, options: CellOptions) -> SimulatedWorld:
    """The world of a cell."""
    world = make_world(
        spec,
        robot_model,
        seed=options.seed,
        goal=options.goal,
        perception=options.perception,
        visuals=options.visuals,
        pace=options.pace,
        permitted_skills=options.permitted_skills,
        instruction_judge=make_instruction_judge(options.instruction),
    )
    if options.configuration is not None:
        world.plant.set_configuration(*options.configuration)
    return world


@contextmanager
def open_filter(
    robot_model: RobotModel, target: str = "", obstacles: Sequence[Obstacle] = ()
) -> Generator[SafetyFilter]:
    """The filter of a cell with permanent `obstacles`: in this process, or on the emulated board `target`.

    Raises:
        UnknownNameError: there is no such board.
        ConfigurationError: a toolchain or the emulator is missing, or the robot does not fit a target.
    """
    config = operating_config(robot_model)
    if not target:
        yield SafetyFilter(robot_model, config, obstacles=obstacles)
        return
    from dualbrain.safety.target.target_filter import EmulatedTarget  # noqa: PLC0415  (needs the extra `target`)

    with EmulatedTarget(target, robot_model, config) as board:
        yield board.filter(obstacles)


def _encoded(contract: str | dict[str, Any]) -> bytes:
    return contract.encode("utf-8", "surrogatepass") if isinstance(contract, str) else msgspec.json.encode(contract)
