"""Backends of a session: the simulator in this process, or a gatekeeper process in real time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from dualbrain.control.executor import Executor
from dualbrain.control.recording.trace import Trace
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.planner.camera_image import CameraImage
from dualbrain.records import ObjectLimits
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.config import Clocks, RunConfig, RunObserver
from dualbrain.runtime.episode import GroundTruth
from dualbrain.runtime.planning.planning_time import PlanningClock
from dualbrain.safety.cbf.obstacles import Obstacle, PersonLimits
from dualbrain.simulation.plant.end_state import EndState
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import SimulatedWorld


@dataclass(frozen=True, slots=True, kw_only=True)
class RunContext:
    """The parts of a session that a backend needs.

    `world` is the simulated world of this process; a backend that moves another robot uses it for camera images only.
    `start` is the end of the run that this one continues. `versions` are recorded with the run, `image_features` and
    `camera_image` return features and image of the camera, `interrupted`: a person wants the robot to stop.
    """

    config: RunConfig
    clocks: Clocks
    robot_model: RobotModel
    spec: SceneSpec
    world: SimulatedWorld
    fixed_obstacles: tuple[Obstacle, ...]
    persons: PersonLimits | None
    object_limits: Mapping[str, ObjectLimits]
    start: EndState | None
    versions: dict[str, str]
    image_features: Callable[[], ImageFeatures | None]
    camera_image: Callable[[], CameraImage | None]
    interrupted: Callable[[], bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningRobot:
    """A robot that is ready for episodes."""

    executor: Executor
    clock: PlanningClock
    ground_truth: GroundTruth


class Backend(Protocol):
    """Makes a robot run for the duration of a context, and returns the recorded trace afterwards."""

    def start(self, context: RunContext, observer: RunObserver) -> AbstractContextManager[RunningRobot]:
        """The running robot; leaving the context stops it and completes the recording."""
        ...

    def trace(self, context: RunContext) -> Trace:
        """The trace of the run, after its end."""
        ...

    def end_state(self, context: RunContext, held: str) -> EndState | None:
        """The state after the end of the run, with `held` in the hand; None if it is not known."""
        ...
