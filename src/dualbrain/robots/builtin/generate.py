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

from dualbrain.errors import UnknownName
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.builtin import fr3, mobile_base, mobile_panda, panda, ur5e
from dualbrain.robots.collision_model.coverage import Balls, measure_excess
from dualbrain.robots.collision_model.fit_problem import LinkCover
from dualbrain.robots.collision_model.self_collision import choose_pairs
from dualbrain.robots.collision_model.sphere_fit import FitOptions, fit_cover
from dualbrain.robots.loader import BODIES, data_file, encode, load_body
from dualbrain.robots.model import Body, BodySphere, Bound, Gripper, Joint, Link, Tool, Tracking, Vector

Tell = Callable[[str], None]

CONFIGURATIONS = 100_000
UNKNOWN = Tracking(0.002, 0.01, 3.0, "a guess: run `dualbrain robot identify`", "computed_torque")
"""What a body starts with that nobody has driven yet."""


class Facts(Protocol):
    """A module of facts about one body, written by hand: `panda.py` and its like."""

    SOURCE: str
    LICENCE: str
    COVER: dict[str, tuple[LinkCover, ...]]
    STATED_PAIRS: dict[tuple[str, str], str]
    TOOL: Tool
    GRIPPER: Gripper
    HOME: tuple[float, ...]
    PERIOD: float
    TOOL_SPEED: Bound

    def part(self, name: str) -> Mesh:
        """One convex part of the cover problem, in its link's frame."""
        ...

    def mirrored(self, centres: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ball centres of a right part from those of the left one."""
        ...

    def joints(self) -> tuple[Joint, ...]:
        """The joints with limits and the provenance of each."""
        ...

    def links(self) -> tuple[Link, ...]:
        """The links."""
        ...


def make(name: str, seed: int, options: FitOptions, configurations: int, tell: Tell) -> Body:
    """The body called `name`: its facts, spheres fitted to its parts, pairs chosen by sampling."""
    facts, known = FACTS[name], load_body(name) if name in BODIES and data_file(name).is_file() else None
    cover = fit(facts, seed, options, tell)
    joints, links = facts.joints(), facts.links()
    tell(f"self pairs: {configurations} random configurations")
    rng = np.random.default_rng([seed, len(links)])
    pairs = choose_pairs(
        joints, links, cover, stated=facts.STATED_PAIRS, count=configurations, rng=rng,
        opening=facts.GRIPPER.opening.value,
    )  # fmt: skip
    return Body(
        name=name,
        source=facts.SOURCE,
        licence=facts.LICENCE,
        joints=joints,
        links=links,
        spheres=tuple(sphere for link, balls in cover.items() for sphere in _spheres(link, balls)),
        self_pairs=pairs,
        tool=facts.TOOL,
        gripper=facts.GRIPPER,
        home=facts.HOME,
        tracking=known.tracking if known else UNKNOWN,
        period=facts.PERIOD,
        tool_speed=facts.TOOL_SPEED,
        other_drives=known.other_drives if known else (),
    )


def fit(facts: Facts, seed: int, options: FitOptions, tell: Tell) -> dict[str, Balls]:
    """Balls of every link; each part draws from its own generator, so one part's change leaves the others alone."""
    cover: dict[str, Balls] = {}
    for i, (name, parts) in enumerate(facts.COVER.items()):
        fitted = [_fit_part(facts, wanted, [seed, i, *([1 + k] if k else [])], options, tell)
                  for k, wanted in enumerate(parts)]  # fmt: skip
        cover[name] = Balls(
            np.vstack([balls.centres for balls in fitted]), np.concatenate([balls.radii for balls in fitted])
        )
        if name.startswith("left_"):
            cover[name.replace("left_", "right_")] = Balls(facts.mirrored(cover[name].centres), cover[name].radii)
    return cover


def _fit_part(facts: Facts, wanted: LinkCover, seed: list[int], options: FitOptions, tell: Tell) -> Balls:
    mesh = facts.part(wanted.mesh)
    balls = fit_cover(mesh, wanted, np.random.default_rng(seed), options)
    excess = measure_excess(mesh, balls, 3000, np.random.default_rng([*seed, 1]))
    said = f"excess mean {excess.mean * 1e3:.1f} mm, worst {excess.worst * 1e3:.1f} mm"
    tell(f"{wanted.mesh}: {wanted.balls} balls, {said}")
    return balls


def _spheres(link: str, balls: Balls) -> list[BodySphere]:
    """The balls of one link as data, 10 µm resolution."""
    return [
        BodySphere(link, _vector(centre), round(float(radius), 5))
        for centre, radius in zip(balls.centres, balls.radii, strict=True)
    ]


def _vector(values: NDArray[np.float64]) -> Vector:
    """Three plain floats, without negative zeros."""
    x, y, z = (round(float(value), 5) + 0.0 for value in values)
    return (x, y, z)


FACTS: dict[str, Facts] = {"panda": panda, "fr3": fr3, "ur5e": ur5e}
"""To add a body, write its facts and name them here and in `BODIES`."""


def _base(known: Body | None) -> Body:
    return mobile_base.body(known.tracking if known else UNKNOWN)


def _mobile_panda(known: Body | None) -> Body:
    tracking, lag = (known.tracking, known.base_lag) if known else (UNKNOWN, 0.0)
    return mobile_panda.body(load_body("panda"), tracking, lag)


DRIVING: dict[str, Callable[[Body | None], Body]] = {"base": _base, "mobile_panda": _mobile_panda}
"""Bodies that drive are put together from what is known; handed over is what the old file holds."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: `panda --out FILE [--seed N]`; progress on stderr."""
    parser = argparse.ArgumentParser(prog="python -m dualbrain.robots.builtin.generate", description=__doc__)
    parser.add_argument("body", help=f"one of {', '.join(FACTS)}")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    if asked.body not in (*FACTS, *DRIVING):
        raise UnknownName("robot", asked.body, (*FACTS, *DRIVING))
    if asked.body in DRIVING:
        known = load_body(asked.body) if data_file(asked.body).is_file() else None
        body = DRIVING[asked.body](known)
    else:
        body = make(asked.body, asked.seed, FitOptions(), CONFIGURATIONS, _to_stderr)
    asked.out.write_bytes(encode(body))
    _to_stderr(f"{asked.out}: {len(body.spheres)} spheres, {len(body.self_pairs.kept)} link pairs kept")
    return 0


def _to_stderr(line: str) -> None:
    """One line of progress."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    raise SystemExit(main())
