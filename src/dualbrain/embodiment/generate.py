"""Makes a body's data file: fits its spheres to the collision meshes and sorts its link pairs.

`python -m dualbrain.embodiment.generate panda --out FILE`; the same version and seed give the same file, byte for byte.
How the joints track is identified on the plant (`dualbrain robot identify --write`) and taken over from the old file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualbrain.embodiment import panda
from dualbrain.embodiment.body import BODIES, Body, BodySphere, Vector, encode, load_body
from dualbrain.embodiment.meshes import collision_mesh
from dualbrain.embodiment.self_pairs import choose_pairs
from dualbrain.embodiment.sphere_cover import Balls, measure_excess
from dualbrain.embodiment.sphere_fit import FitOptions, fit_cover
from dualbrain.errors import UnknownName

Tell = Callable[[str], None]

CONFIGURATIONS = 100_000


def make_panda(seed: int, options: FitOptions, configurations: int, tell: Tell) -> Body:
    """The Panda with its hand: facts of panda.py, spheres fitted to the meshes, pairs chosen by sampling."""
    known = load_body("panda")
    cover = fit_panda(seed, options, tell)
    joints, links = panda.joints(), panda.links()
    tell(f"self pairs: {configurations} random configurations")
    rng = np.random.default_rng([seed, len(links)])
    pairs = choose_pairs(joints, links, cover, stated=panda.STATED_PAIRS, count=configurations, rng=rng)
    return Body(
        name="panda",
        source=panda.SOURCE,
        licence=panda.LICENCE,
        joints=joints,
        links=links,
        spheres=tuple(sphere for name, balls in cover.items() for sphere in _spheres(name, balls)),
        self_pairs=pairs,
        tool=panda.TOOL,
        gripper=panda.GRIPPER,
        home=panda.HOME,
        tracking=known.tracking,
        period=panda.PERIOD,
        tool_speed=panda.TOOL_SPEED,
        other_drives=known.other_drives,
    )


def fit_panda(seed: int, options: FitOptions, tell: Tell) -> dict[str, Balls]:
    """Balls of every link; each link draws from its own generator, so one link's change leaves the others alone."""
    cover: dict[str, Balls] = {}
    for i, (name, wanted) in enumerate(panda.COVER.items()):
        mesh = collision_mesh("panda", wanted.mesh)
        balls = fit_cover(mesh, wanted, np.random.default_rng([seed, i]), options)
        excess = measure_excess(mesh, balls, 3000, np.random.default_rng([seed, i, 1]))
        cover[name] = balls
        tell(f"{name}: {wanted.balls} balls, excess mean {excess.mean * 1e3:.1f} mm, worst {excess.worst * 1e3:.1f} mm")
    left = cover["left_finger"]
    cover["right_finger"] = Balls(left.centres * np.array([-1.0, -1.0, 1.0]), left.radii)
    return cover


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


MAKERS: dict[str, Callable[[int, FitOptions, int, Tell], Body]] = {"panda": make_panda}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: `panda --out FILE [--seed N]`; progress on stderr."""
    parser = argparse.ArgumentParser(prog="python -m dualbrain.embodiment.generate", description=__doc__)
    parser.add_argument("body", help=f"one of {', '.join(BODIES)}")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    if asked.body not in MAKERS:
        raise UnknownName("robot", asked.body, tuple(MAKERS))
    body = MAKERS[asked.body](asked.seed, FitOptions(), CONFIGURATIONS, _to_stderr)
    asked.out.write_bytes(encode(body))
    _to_stderr(f"{asked.out}: {len(body.spheres)} spheres, {len(body.self_pairs.kept)} link pairs kept")
    return 0


def _to_stderr(line: str) -> None:
    """One line of progress."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    raise SystemExit(main())
