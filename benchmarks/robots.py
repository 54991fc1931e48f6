"""Time of one filter step on every robot [µs], and its ratio to that of the Panda; the robots alternate in one process.

    python -m benchmarks.robots [--rounds 40]

Each robot is at its home posture with open fingers in its first bare scene (mobile robots in an empty room or a
workroom), with half of its maximum speed as nominal control. The table holds the median over rounds of the mean
processor time, and the median and the interquartile range of the ratios within a round. `two_pandas` is a synthetic
robot with fourteen joints: an arm mounted on the flange of another one, with all pairs of nonadjacent links as
self-collision pairs.
"""

from __future__ import annotations

import argparse
import statistics
import time

import msgspec
import numpy as np

from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.records import Scene
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import SIMULATED_ROBOTS, load_robot
from dualbrain.robots.model import RobotModel, SelfCollisionPairs, Tool
from dualbrain.safety.barriers.traversable_region import traversable_region
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.simulation.scenes.generators.catalogue import open_scene

STEPS = 500
FLANGE_OFFSET = (0.0, 0.0, 0.25)
UPRIGHT_POSTURE = (0.0, -0.2, 0.0, -0.4, 0.0, 0.4, 0.0)
"""Mounting position of the second arm on the flange of the first [m], and the almost upright posture of the first."""


def two_pandas() -> RobotModel:
    """Return a robot model with fourteen joints in one chain."""
    panda = load_robot("panda")
    own = {link.name for link in panda.links if link.group == "arm"}
    first = msgspec.structs.replace(
        panda.joints[0], translation=(0.0, 0.0, FLANGE_OFFSET[2] + panda.joints[0].translation[2])
    )
    upper = [msgspec.structs.replace(joint, name=f"upper_{joint.name}") for joint in (first, *panda.joints[1:])]
    above = [
        msgspec.structs.replace(
            link,
            name=f"upper_{link.name}",
            frame=link.frame + 7,
            translation=FLANGE_OFFSET if link.frame == 0 else link.translation,
        )
        for link in panda.links
    ]
    below = [link for link in panda.links if link.name in own]
    spheres = [sphere for sphere in panda.spheres if sphere.link in own]
    spheres += [msgspec.structs.replace(sphere, link=f"upper_{sphere.link}") for sphere in panda.spheres]
    pairs = [pair for pair in panda.self_pairs.kept if own >= set(pair)]
    pairs += [(f"upper_{a}", f"upper_{b}") for a, b in panda.self_pairs.kept]
    pairs += [(a.name, b.name) for a in below for b in above if b.frame - a.frame > 2]
    return msgspec.structs.replace(
        panda,
        name="two_pandas",
        joints=(*panda.joints, *upper),
        links=(*below, *above),
        spheres=tuple(spheres),
        self_pairs=SelfCollisionPairs(tuple(pairs), ()),
        home=(*UPRIGHT_POSTURE, *panda.home),
        tool=Tool("upper_hand", panda.tool.translation),
    )


SYNTHETIC_ROBOTS = {"two_pandas": two_pandas}


def robot_scene(robot_model: RobotModel) -> Scene:
    """Return the scene of the benchmark for a robot."""
    family = (
        "workroom:0" if robot_model.is_mobile_manipulator else "empty_room:0" if robot_model.is_mobile else "bare:0"
    )
    robot = robot_model.name if robot_model.name in SIMULATED_ROBOTS else "panda"
    return scene_from_spec(open_scene(family, robot))


def make_filter(name: str) -> SafetyFilter:
    """Return a filter for the robot `name` that observes the obstacles of its scene."""
    robot_model = SYNTHETIC_ROBOTS[name]() if name in SYNTHETIC_ROBOTS else load_robot(name)
    scene = robot_scene(robot_model)
    safety = SafetyFilter(robot_model)
    safety.observe(
        (
            *obstacles_from_scene(scene, known=(), held=None),
            *(traversable_region("floor", scene.region) if scene.region else ()),
        )
    )
    return safety


def mean_us(safety: SafetyFilter) -> float:
    """Return the mean processor time of a step over STEPS steps [µs]."""
    state = home_state(safety.robot_model)
    u_nom = 0.5 * np.array([joint.velocity.value for joint in safety.robot_model.joints])
    start = time.thread_time()
    for _ in range(STEPS):
        safety.filter(state, u_nom, 0.0)
    return (time.thread_time() - start) / STEPS * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    filters = {name: make_filter(name) for name in (*SIMULATED_ROBOTS, *SYNTHETIC_ROBOTS)}
    rounds = parser.parse_args().rounds
    times = {name: [] for name in filters}
    for _ in range(rounds):
        for name, safety in filters.items():
            times[name].append(mean_us(safety))
    print(
        "| robot | n | spheres | self-collision pairs | obstacles | µs | ratio to the Panda "
        "|\n|---|---|---|---|---|---|---|"
    )
    for name, safety in filters.items():
        median, robot_model = statistics.median(times[name]), safety.robot_model
        ratios = [own / panda for own, panda in zip(times[name], times["panda"], strict=True)]
        low, ratio, high = statistics.quantiles(ratios, n=4, method="inclusive")
        n_pairs = len(robot_model.self_pairs.kept)
        sizes = f"{robot_model.n} | {len(robot_model.spheres)} | {n_pairs} | {len(safety._obstacles)}"
        print(f"| {name} | {sizes} | {median:.1f} | {ratio:.2f} ({low:.2f}–{high:.2f}) |")


if __name__ == "__main__":
    main()
