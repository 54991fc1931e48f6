"""Makes a body's data file: fits its spheres to the collision meshes and sorts its link pairs.

`python -m dualbrain.robots.builtin.generate panda --out FILE`; the same version and seed give the same file, byte for byte.
How the joints track is identified on the plant (`dualbrain robot identify --write`) and taken over from the old file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UnknownNameError
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.builtin import fr3, mobile_base, mobile_panda, panda, ur5e
from dualbrain.robots.collision_model.coverage import SphereSet, measure_excess
from dualbrain.robots.collision_model.fit_problem import LinkCoverSpec
from dualbrain.robots.collision_model.self_collision import choose_pairs
from dualbrain.robots.collision_model.sphere_fit import FitOptions, fit_cover
from dualbrain.robots.loader import BUILTIN_ROBOTS, data_file, encode_robot, load_robot
from dualbrain.robots.model import (
    Bound,
    CollisionSphere,
    Gripper,
    Joint,
    Link,
    RobotModel,
    Tool,
    TrackingErrorModel,
    Vector,
)

ProgressReporter = Callable[[str], None]

N_CONFIGURATIONS = 100_000
DEFAULT_TRACKING = TrackingErrorModel(
    lag=0.002,
    position_error=0.01,
    rate=3.0,
    provenance="a guess: run `dualbrain robot identify`",
    drive="computed_torque",
)
"""What a body starts with that nobody has driven yet."""


class RobotDefinition(Protocol):
    """A module of facts about one body, written by hand: `panda.py` and its like."""

    SOURCE: str
    LICENCE: str
    LINK_COVERS: dict[str, tuple[LinkCoverSpec, ...]]
    ALLOWED_PAIRS: dict[tuple[str, str], str]
    TOOL: Tool
    GRIPPER: Gripper
    HOME: tuple[float, ...]
    PERIOD: float
    TOOL_SPEED: Bound

    def part_mesh(self, name: str) -> Mesh:
        """One convex part of the cover problem, in its link's frame."""
        ...

    def mirror_centres(self, centres: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ball centres of a right part from those of the left one."""
        ...

    def joints(self) -> tuple[Joint, ...]:
        """The joints with limits and the provenance of each."""
        ...

    def links(self) -> tuple[Link, ...]:
        """The links."""
        ...


def make_arm(
    name: str, seed: int, options: FitOptions, n_configurations: int, report_progress: ProgressReporter
) -> RobotModel:
    """The body called `name`: its facts, spheres fitted to its parts, pairs chosen by sampling."""
    facts, known = (
        ARM_DEFINITIONS[name],
        load_robot(name) if name in BUILTIN_ROBOTS and data_file(name).is_file() else None,
    )
    cover = fit_spheres(facts, seed, options, report_progress)
    joints, links = facts.joints(), facts.links()
    report_progress(f"self pairs: {n_configurations} random configurations")
    rng = np.random.default_rng([seed, len(links)])
    pairs = choose_pairs(
        joints,
        links,
        cover,
        allowed_by_design=facts.ALLOWED_PAIRS,
        n_samples=n_configurations,
        rng=rng,
        opening=facts.GRIPPER.opening.value,
    )
    return RobotModel(
        name=name,
        source=facts.SOURCE,
        licence=facts.LICENCE,
        joints=joints,
        links=links,
        spheres=tuple(sphere for link, balls in cover.items() for sphere in _to_collision_spheres(link, balls)),
        self_pairs=pairs,
        tool=facts.TOOL,
        gripper=facts.GRIPPER,
        home=facts.HOME,
        tracking=known.tracking if known else DEFAULT_TRACKING,
        period=facts.PERIOD,
        tool_speed=facts.TOOL_SPEED,
        other_drives=known.other_drives if known else (),
    )


def fit_spheres(
    definition: RobotDefinition, seed: int, options: FitOptions, report_progress: ProgressReporter
) -> dict[str, SphereSet]:
    """Balls of every link; each part draws from its own generator, so one part's change leaves the others alone."""
    cover: dict[str, SphereSet] = {}
    for i, (name, parts) in enumerate(definition.LINK_COVERS.items()):
        fitted = [
            _fit_part(definition, wanted, [seed, i, *([1 + k] if k else [])], options, report_progress)
            for k, wanted in enumerate(parts)
        ]
        cover[name] = SphereSet(
            np.vstack([balls.centres for balls in fitted]), np.concatenate([balls.radii for balls in fitted])
        )
        if name.startswith("left_"):
            cover[name.replace("left_", "right_")] = SphereSet(
                definition.mirror_centres(cover[name].centres), cover[name].radii
            )
    return cover


def _fit_part(
    definition: RobotDefinition,
    spec: LinkCoverSpec,
    seed: list[int],
    options: FitOptions,
    report_progress: ProgressReporter,
) -> SphereSet:
    mesh = definition.part_mesh(spec.mesh)
    balls = fit_cover(mesh, spec, np.random.default_rng(seed), options)
    excess = measure_excess(mesh, balls, 3000, np.random.default_rng([*seed, 1]))
    said = f"excess mean {excess.mean * 1e3:.1f} mm, worst {excess.worst * 1e3:.1f} mm"
    report_progress(f"{spec.mesh}: {spec.n_spheres} balls, {said}")
    return balls


def _to_collision_spheres(link: str, balls: SphereSet) -> list[CollisionSphere]:
    """The balls of one link as data, 10 µm resolution."""
    return [
        CollisionSphere(link, _to_vector(centre), round(float(radius), 5))
        for centre, radius in zip(balls.centres, balls.radii, strict=True)
    ]


def _to_vector(values: NDArray[np.float64]) -> Vector:
    """Three plain floats, without negative zeros."""
    x, y, z = (round(float(value), 5) + 0.0 for value in values)
    return (x, y, z)


ARM_DEFINITIONS: dict[str, RobotDefinition] = {"panda": panda, "fr3": fr3, "ur5e": ur5e}
"""To add a body, write its facts and name them here and in `BODIES`."""


def _make_base(known: RobotModel | None) -> RobotModel:
    return mobile_base.make_model(known.tracking if known else DEFAULT_TRACKING)


def _make_mobile_panda(known: RobotModel | None) -> RobotModel:
    tracking, lag = (known.tracking, known.base_lag) if known else (DEFAULT_TRACKING, 0.0)
    return mobile_panda.make_model(load_robot("panda"), tracking, lag)


MOBILE_ROBOTS: dict[str, Callable[[RobotModel | None], RobotModel]] = {
    "base": _make_base,
    "mobile_panda": _make_mobile_panda,
}
"""Bodies that drive are put together from what is known; handed over is what the old file holds."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: `panda --out FILE [--seed N]`; progress on stderr."""
    parser = argparse.ArgumentParser(prog="python -m dualbrain.robots.builtin.generate", description=__doc__)
    parser.add_argument("body", help=f"one of {', '.join(ARM_DEFINITIONS)}")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    if asked.body not in (*ARM_DEFINITIONS, *MOBILE_ROBOTS):
        raise UnknownNameError("robot", asked.body, (*ARM_DEFINITIONS, *MOBILE_ROBOTS))
    if asked.body in MOBILE_ROBOTS:
        known = load_robot(asked.body) if data_file(asked.body).is_file() else None
        robot_model = MOBILE_ROBOTS[asked.body](known)
    else:
        robot_model = make_arm(asked.body, asked.seed, FitOptions(), N_CONFIGURATIONS, _to_stderr)
    asked.out.write_bytes(encode_robot(robot_model))
    _to_stderr(f"{asked.out}: {len(robot_model.spheres)} spheres, {len(robot_model.self_pairs.kept)} link pairs kept")
    return 0


def _to_stderr(line: str) -> None:
    """One line of progress."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    raise SystemExit(main())
