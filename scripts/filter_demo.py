"""Simulated motion for the images of the documentation: a tool that crosses the way of a person's arm.

The nominal control moves the tool of a Panda back and forth along a straight line and ignores the person. It is the
same with and without the filter; without it, the nominal control is written to the robot.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace

os.environ.setdefault("MUJOCO_GL", "egl")

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.core.geometry.shapes import Capsule
from dualbrain.records import Scene
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import CellOptions, open_world
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.safety.cbf.result import FilterResult
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld

Array = NDArray[np.float64]

ROBOT = load_robot("panda")
SCENE = "8"
PERSON = {"start": (0.72, -0.62, 0.24), "end": (0.72, 0.62, 0.24), "speed": 0.16, "pause": 0.8, "phase": 0.0}
"""Path of the arm of the person: positions [m], speed [m/s], rest at both ends [s], start in the cycle [s]."""
LINE = np.array([[0.50, 0.38, 0.22], [0.50, -0.38, 0.22]])
"""End points of the motion of the tool [m]."""
TOOL_SPEED, GAIN = 0.25, 4.0
"""Speed of the tool [m/s], gain of the position and the rotation [1/s]."""
DURATION_S, PERCEPTION_PERIOD_S, START_TIME_S = 11.0, 0.033, 2.5
"""Duration of the run, time between two observations, time in which the tool reaches the start of the line [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoTick:
    """One tick: state, perceived scene, filter result, and the true distance [m] between robot and person."""

    state: RobotState
    scene: Scene
    result: FilterResult
    distance: float


def open_demo_world() -> SimulatedWorld:
    """The world with the person on the path of the images."""
    spec = open_scene(SCENE)
    assert spec.mover is not None, "scene 8 has a moving person"
    return open_world(replace_mover(spec), ROBOT, CellOptions(visuals=True))


def replace_mover(spec):
    """`spec` with the path of the person in `PERSON`."""
    change = msgspec.structs.replace if isinstance(spec, msgspec.Struct) else replace
    move = msgspec.structs.replace if isinstance(spec.mover, msgspec.Struct) else replace
    return change(spec, mover=move(spec.mover, **PERSON))


def run_demo(world: SimulatedWorld, *, guard: bool) -> Iterator[DemoTick]:
    """The ticks of the run, one per control period; with `guard` the filtered control is written, else the nominal."""
    safety, plant = SafetyFilter(ROBOT, operating_config(ROBOT)), world.plant
    upright = safety.tool(plant.read().q).rotation
    scene = world.perceive()
    safety.observe(obstacles_from_scene(scene, known=(), held=None), scene.stamp)
    u_nom, perceived_at = np.zeros(ROBOT.n), 0.0
    while (state := plant.read()).stamp < DURATION_S:
        if state.stamp - perceived_at >= PERCEPTION_PERIOD_S:
            scene, perceived_at = world.perceive(), state.stamp
            safety.observe(obstacles_from_scene(scene, known=(), held=None), scene.stamp)
        u_nom = nominal_control(safety, state, upright, u_nom)
        result = safety.filter(state, u_nom, state.stamp)
        plant.write(Command(np.asarray(result.u, float) if guard else u_nom, 0.04, 20.0))
        yield DemoTick(state=state, scene=scene, result=result, distance=true_distance(safety, plant))
        world.advance()


def nominal_control(safety: SafetyFilter, state: RobotState, upright: Array, previous: Array) -> Array:
    """Joint velocities [rad/s] that move the tool along the line; their change is limited as the robot requires."""
    tool = safety.tool(state.q)
    way = target_at(state.stamp) - tool.position
    velocity = GAIN * way * min(1.0, TOOL_SPEED / max(GAIN * float(np.linalg.norm(way)), 1e-9))
    twist = np.concatenate([velocity, 1.5 * rotation_error(tool.rotation, upright)])
    u = safety.damped_least_squares(tool.jacobian, 1e-3, twist, np.zeros(ROBOT.n))
    step = 5.0 * ROBOT.period
    return np.clip(u, previous - step, previous + step)


def target_at(t: float) -> Array:
    """Position [m] of the target at `t` [s]: the start of the line, then a point that moves along it and back."""
    length = float(np.linalg.norm(LINE[1] - LINE[0]))
    distance = max(0.0, t - START_TIME_S) * TOOL_SPEED % (2.0 * length)
    share = (distance if distance <= length else 2.0 * length - distance) / length
    return LINE[0] + share * (LINE[1] - LINE[0])


def true_distance(safety: SafetyFilter, plant: Plant) -> float:
    """Smallest distance [m] between the spheres that cover the robot and the arm of the person; negative in contact."""
    mover = plant.spec.mover
    assert mover is not None, "there is a moving person"
    state = plant.read()
    centres, radii, _ = safety.spheres(state.q, state.opening)
    shape = Capsule(mover.radius, mover.half_length)
    return float((signed_distance(shape, plant.true_pose(mover.name), centres) - radii).min())
