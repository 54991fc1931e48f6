"""Backend that simulates the robot in this process, in lockstep with the control loop."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

from dualbrain.control.control_loop import ControlLoopConfig, LoopInputs, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.recording_file import reserve_for_recording
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.loader import BUILTIN_ROBOTS
from dualbrain.runtime.assembly import SimulatedCell, open_filter
from dualbrain.runtime.backends.backend import RunContext, RunningRobot
from dualbrain.runtime.config import RunObserver
from dualbrain.runtime.episode import GroundTruth
from dualbrain.runtime.planning.planning_time import PLANNING_TIME, PlanningClock
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.plant.end_state import EndState, read_end_state


class SimulatedBackend:
    """Runs the session's own simulated world."""

    def __init__(self) -> None:
        """Nothing runs yet."""
        self._trace: Trace | None = None

    @contextmanager
    def start(self, context: RunContext, observer: RunObserver) -> Generator[RunningRobot]:
        """The simulated robot; every tick is recorded in `episode.mcap` of the run folder."""
        with open_filter(context.robot_model, context.config.target, context.fixed_obstacles) as safety:
            yield from self._start(context, observer, safety)

    def _start(self, context: RunContext, observer: RunObserver, safety: SafetyFilter) -> Generator[RunningRobot]:
        config, model = context.config, context.robot_model
        trace = self._trace = Trace(model.n, model.nq)
        path = config.out / "episode.mcap"
        reserve = reserve_for_recording(path, unrecorded=config.unrecorded)
        with Recorder(path, trace, when_full="wait", reserve=reserve) as recorder:
            log = FlightLog(trace, recorder, observer.on_event, observer.on_attempt)
            recorder.episode(0.0, {**_recording_metadata(context), "versions": context.versions})
            world = context.world
            cell = SimulatedCell(
                model,
                world,
                safety=safety,
                log=log,
                config=ControlLoopConfig(
                    guard=config.guard,
                    unrecorded=config.unrecorded,
                    persons=context.persons,
                    object_limits=context.object_limits,
                ),
                observer=LoopObserver(on_tick=observer.on_tick, on_phase=lambda phase, roles: observer.on_phase(phase)),
                inputs=LoopInputs(interrupted=context.interrupted, clock=lambda: world.plant.now),
            )
            if context.start is not None:
                grip = context.start.robot
                cell.loop.resume_grasp(context.start.held, grip.target_opening, grip.grip_force)
            planning_time = 0.0 if config.contract else PLANNING_TIME
            truth = GroundTruth(
                start_contract=world.start_contract,
                judge=world.judgement,
                versions=context.versions,
                image_features=context.image_features,
                camera_image=context.camera_image,
            )
            clock = PlanningClock(context.clocks.clock, config.measured, planning_time)
            try:
                yield RunningRobot(executor=cell.executor, clock=clock, ground_truth=truth)
            finally:
                if text := safety.describe_target():
                    log.note(world.plant.now, "target", text)
                world.plant.stop()

    def trace(self, context: RunContext) -> Trace:
        """The recorded trace."""
        return self._trace or Trace(context.robot_model.n, context.robot_model.nq)

    def end_state(self, context: RunContext, held: str) -> EndState | None:
        """The state of the session's own simulated world."""
        return read_end_state(context.world.plant, held)


def _recording_metadata(context: RunContext) -> dict[str, object]:
    """Metadata of the recording; with a site file, everything about the site that a replay needs."""
    config = context.config
    about: dict[str, object] = {"robot": config.robot, "guard": config.guard, "instruction": config.instruction}
    about["cartesian_speed"] = operating_config(context.robot_model).cartesian_speed
    if config.site or config.robot not in BUILTIN_ROBOTS:  # a recording names known robots only
        about |= {"body": context.robot_model, "standing": context.fixed_obstacles}
    return about
