"""One filter step on every body, in µs and as a ratio to the Panda's: the bodies take turns in one process.

    python benchmarks/robots.py [--rounds 40]

Each stands at home, fingers open, in front of its first bare scene (what drives in an empty room or a workroom) and
wishes for half its speed. Told are the median of the rounds' means, in processor time, which waiting for others does
not lengthen, and the median and the middle half of the ratios within each round. No shipped body has fourteen joints:
`two_pandas` is made here, one arm standing at the other's flange, with every pair of their parts kept apart that is not
adjacent.
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
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.robots.model import RobotModel, SelfCollisionPairs, Tool
from dualbrain.safety.barriers.traversable_region import traversable_region
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.simulation.scenes.generators.catalogue import open_scene

STEPS = 500
FLANGE_OFFSET = (0.0, 0.0, 0.25)
UPRIGHT_POSTURE = (0.0, -0.2, 0.0, -0.4, 0.0, 0.4, 0.0)
"""Where the second arm stands on the first, which is held almost straight up."""


def two_pandas() -> RobotModel:
    """Fourteen joints in one chain."""
    low = load_robot("panda")
    own = {link.name for link in low.links if link.group == "arm"}
    first = msgspec.structs.replace(
        low.joints[0], translation=(0.0, 0.0, FLANGE_OFFSET[2] + low.joints[0].translation[2])
    )
    upper = [msgspec.structs.replace(joint, name=f"upper_{joint.name}") for joint in (first, *low.joints[1:])]
    above = [
        msgspec.structs.replace(
            link,
            name=f"upper_{link.name}",
            frame=link.frame + 7,
            translation=FLANGE_OFFSET if link.frame == 0 else link.translation,
        )
        for link in low.links
    ]
    below = [link for link in low.links if link.name in own]
    balls = [sphere for sphere in low.spheres if sphere.link in own]
    balls += [msgspec.structs.replace(sphere, link=f"upper_{sphere.link}") for sphere in low.spheres]
    pairs = [pair for pair in low.self_pairs.kept if own >= set(pair)]
    pairs += [(f"upper_{a}", f"upper_{b}") for a, b in low.self_pairs.kept]
    pairs += [(a.name, b.name) for a in below for b in above if b.frame - a.frame > 2]
    return msgspec.structs.replace(
        low,
        name="two_pandas",
        joints=(*low.joints, *upper),
        links=(*below, *above),
        spheres=tuple(balls),
        self_pairs=SelfCollisionPairs(tuple(pairs), ()),
        home=(*UPRIGHT_POSTURE, *low.home),
        tool=Tool("upper_hand", low.tool.translation),
    )


SYNTHETIC_ROBOTS = {"two_pandas": two_pandas}


def robot_scene(robot_model: RobotModel) -> Scene:
    """The scene that a body stands in."""
    family = (
        "workroom:0" if robot_model.is_mobile_manipulator else "empty_room:0" if robot_model.is_mobile else "bare:0"
    )
    robot = robot_model.name if robot_model.name in BUILTIN_ROBOTS else "panda"
    return scene_from_spec(open_scene(family, robot))


def make_filter(name: str) -> SafetyFilter:
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
    state = home_state(safety.robot_model)
    wish = 0.5 * np.array([joint.velocity.value for joint in safety.robot_model.joints])
    start = time.thread_time()
    for _ in range(STEPS):
        safety.filter(state, wish, 0.0)
    return (time.thread_time() - start) / STEPS * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    filters = {name: make_filter(name) for name in (*BUILTIN_ROBOTS, *SYNTHETIC_ROBOTS)}
    rounds = parser.parse_args().rounds
    times = {name: [] for name in filters}
    for _ in range(rounds):
        for name, safety in filters.items():
            times[name].append(mean_us(safety))
    print("| body | n | spheres | pairs kept | obstacles | µs | ratio to the Panda |\n|---|---|---|---|---|---|---|")
    for name, safety in filters.items():
        middle, robot_model = statistics.median(times[name]), safety.robot_model
        ratios = [mine / panda for mine, panda in zip(times[name], times["panda"], strict=True)]
        low, ratio, high = statistics.quantiles(ratios, n=4, method="inclusive")
        sizes = f"{robot_model.n} | {len(robot_model.spheres)} | {len(robot_model.self_pairs.kept)} | {len(safety._obstacles)}"
        print(f"| {name} | {sizes} | {middle:.1f} | {ratio:.2f} ({low:.2f}–{high:.2f}) |")


if __name__ == "__main__":
    main()
