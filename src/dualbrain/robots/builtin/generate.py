"""Generator of the data files of the packaged robots: fits spheres to the collision meshes and sorts link pairs.

`python -m dualbrain.robots.builtin.generate panda --out FILE`; the same version and seed give the same bytes. The
tracking-error model is identified on the simulated plant (`dualbrain robot identify --write`) and copied from the
existing data file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UnknownNameError
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.builtin import fr3, mobile_base, mobile_panda, panda, so101, ur5e, vx300s
from dualbrain.robots.collision_model.coverage import SphereSet, measure_excess
from dualbrain.robots.collision_model.fit_problem import LinkCoverSpec
from dualbrain.robots.collision_model.self_collision import choose_pairs
from dualbrain.robots.collision_model.sphere_fit import FitOptions, fit_cover
from dualbrain.robots.loader import BUILTIN_ROBOTS, data_file, encode_robot, load_robot
from dualbrain.robots.model import (
    Bound,
    CollisionSphere,
    DynamicModel,
    ForceSensing,
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
"""Tracking-error model of a new robot that has not been identified yet."""


class RobotDefinition(Protocol):
    """A module with the hand-written data of one robot, such as `panda.py`."""

    SOURCE: str
    LICENCE: str
    LINK_COVERS: dict[str, tuple[LinkCoverSpec, ...]]
    ALLOWED_PAIRS: dict[tuple[str, str], str]
    TOOL: Tool
    GRIPPER: Gripper
    HOME: tuple[float, ...]
    PERIOD: float
    TOOL_SPEED: Bound
    DYNAMICS: DynamicModel
    FORCE_SENSING: ForceSensing

    def part_mesh(self, name: str) -> Mesh:
        """The mesh of one convex part of a link, in the link frame."""
        ...

    def mirror_centres(self, centres: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sphere centres of a part on the right side from those of the part on the left side."""
        ...

    def joints(self) -> tuple[Joint, ...]:
        """The joints with their limits and the provenance of each limit."""
        ...

    def links(self) -> tuple[Link, ...]:
        """The links."""
        ...


def make_arm(
    name: str, seed: int, options: FitOptions, n_configurations: int, report_progress: ProgressReporter
) -> RobotModel:
    """The model of the arm `name`: its definition, spheres fitted to its parts, link pairs chosen by sampling."""
    definition = ARM_DEFINITIONS[name]
    previous = load_robot(name) if name in BUILTIN_ROBOTS and data_file(name).is_file() else None
    link_covers = OTHER_COVERS.get(name, definition.LINK_COVERS)
    cover = fit_spheres(definition, link_covers, seed, options, report_progress)
    joints, links = definition.joints(), definition.links()
    report_progress(f"self pairs: {n_configurations} random configurations")
    rng = np.random.default_rng([seed, len(links)])
    pairs = choose_pairs(
        joints,
        links,
        cover,
        allowed_by_design=definition.ALLOWED_PAIRS,
        n_samples=n_configurations,
        rng=rng,
        opening=definition.GRIPPER.opening.value,
    )
    return RobotModel(
        name=name,
        source=definition.SOURCE,
        licence=definition.LICENCE,
        joints=joints,
        links=links,
        spheres=tuple(sphere for link, spheres in cover.items() for sphere in _to_collision_spheres(link, spheres)),
        self_pairs=pairs,
        tool=definition.TOOL,
        gripper=definition.GRIPPER,
        home=definition.HOME,
        tracking=previous.tracking if previous else DEFAULT_TRACKING,
        period=definition.PERIOD,
        tool_speed=definition.TOOL_SPEED,
        other_drives=previous.other_drives if previous else (),
        dynamics=definition.DYNAMICS,
        force_sensing=definition.FORCE_SENSING,
    )


def fit_spheres(
    definition: RobotDefinition,
    link_covers: Mapping[str, tuple[LinkCoverSpec, ...]],
    seed: int,
    options: FitOptions,
    report_progress: ProgressReporter,
) -> dict[str, SphereSet]:
    """Spheres of every link; each part has a random generator of its own, so a change of one part affects no other."""
    cover: dict[str, SphereSet] = {}
    for i, (name, parts) in enumerate(link_covers.items()):
        fitted = [
            _fit_part(definition, spec, [seed, i, *([1 + k] if k else [])], options, report_progress)
            for k, spec in enumerate(parts)
        ]
        cover[name] = SphereSet(
            np.vstack([spheres.centres for spheres in fitted]), np.concatenate([spheres.radii for spheres in fitted])
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
    spheres = fit_cover(mesh, spec, np.random.default_rng(seed), options)
    excess = measure_excess(mesh, spheres, 3000, np.random.default_rng([*seed, 1]))
    report_progress(
        f"{spec.mesh}: {spec.n_spheres} spheres, excess mean {excess.mean * 1e3:.1f} mm, "
        f"worst {excess.worst * 1e3:.1f} mm"
    )
    return spheres


def _to_collision_spheres(link: str, spheres: SphereSet) -> list[CollisionSphere]:
    """The spheres of one link as records, rounded to 10 µm."""
    return [
        CollisionSphere(link, _to_vector(centre), round(float(radius), 5))
        for centre, radius in zip(spheres.centres, spheres.radii, strict=True)
    ]


def _to_vector(values: NDArray[np.float64]) -> Vector:
    """Three Python floats, without negative zeros."""
    x, y, z = (round(float(value), 5) + 0.0 for value in values)
    return (x, y, z)


ARM_DEFINITIONS: dict[str, RobotDefinition] = {"panda": panda, "fr3": fr3, "ur5e": ur5e, "ur5e_lean": ur5e}
"""Definitions of the arms. To add a packaged robot, write its definition and add it here and to `BUILTIN_ROBOTS`."""
OTHER_COVERS = {"ur5e_lean": ur5e.LEAN_LINK_COVERS}
"""Cover specifications of the arms that do not have that of their definition."""


def _to_stderr(line: str) -> None:
    """Write one line of progress."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


def _make_base(previous: RobotModel | None) -> RobotModel:
    return mobile_base.make_model(previous.tracking if previous else DEFAULT_TRACKING)


def _make_mobile_panda(previous: RobotModel | None) -> RobotModel:
    tracking, lag = (previous.tracking, previous.base_lag) if previous else (DEFAULT_TRACKING, 0.0)
    return mobile_panda.make_model(load_robot("panda"), tracking, lag)


def _make_so101(previous: RobotModel | None) -> RobotModel:
    return so101.make_model(previous.tracking if previous else DEFAULT_TRACKING, _to_stderr)


def _make_vx300s(previous: RobotModel | None) -> RobotModel:
    return vx300s.make_model(previous.tracking if previous else DEFAULT_TRACKING, _to_stderr)


OTHER_ROBOTS: dict[str, Callable[[RobotModel | None], RobotModel]] = {
    "base": _make_base,
    "mobile_panda": _make_mobile_panda,
    "so101": _make_so101,
    "vx300s": _make_vx300s,
}
"""Functions that make the models of the other robots, from the model in the existing data file."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: `panda --out FILE [--seed N]`; progress on stderr."""
    parser = argparse.ArgumentParser(prog="python -m dualbrain.robots.builtin.generate", description=__doc__)
    parser.add_argument("robot", help=f"one of {', '.join((*ARM_DEFINITIONS, *OTHER_ROBOTS))}")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.robot not in (*ARM_DEFINITIONS, *OTHER_ROBOTS):
        raise UnknownNameError("robot", options.robot, (*ARM_DEFINITIONS, *OTHER_ROBOTS))
    if options.robot in OTHER_ROBOTS:
        previous = load_robot(options.robot) if data_file(options.robot).is_file() else None
        robot_model = OTHER_ROBOTS[options.robot](previous)
    else:
        robot_model = make_arm(options.robot, options.seed, FitOptions(), N_CONFIGURATIONS, _to_stderr)
    options.out.write_bytes(encode_robot(robot_model))
    _to_stderr(f"{options.out}: {len(robot_model.spheres)} spheres, {len(robot_model.self_pairs.kept)} link pairs kept")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
