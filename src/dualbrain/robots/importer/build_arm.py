"""A `Body` from a description: chain, limits, cover, pairs, home, each with its reasons beside it in a report."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion
from dualbrain.errors import InvalidSetup
from dualbrain.robots.assets.mesh_primitives import joined, moved
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.coverage import Balls
from dualbrain.robots.collision_model.polytope import surface_points
from dualbrain.robots.collision_model.self_collision_sampling import Sampled, sampled_pairs
from dualbrain.robots.collision_model.sphere_budget import FULL, QUICK, Fit, fit_all
from dualbrain.robots.importer.cbf_gain import curved_gain
from dualbrain.robots.importer.gripper import Hand, find_hand
from dualbrain.robots.importer.home_posture import find_home
from dualbrain.robots.importer.kinematic_chain import Chain, find_chain
from dualbrain.robots.importer.kinematic_tree import Tree
from dualbrain.robots.importer.report import LinkReport, Report
from dualbrain.robots.importer.required_limits import Missing, MissingLimits, Policy, joint_bounds, whole_bound
from dualbrain.robots.model import Body, BodySphere, Bound, Gripper, Joint, Link, SelfPairs, Tool, Tracking, Vector

Array = NDArray[np.float64]
Tell = Callable[[str], None]

MOST_JOINTS, MOST_SPHERES, MOST_LINKS, MOST_PAIRS = 16, 232, 31, 320
"""The room of the widest build of the kernel (CMakeLists.txt; a test holds them equal)."""
SURFACE = 600
"""Points on each link's shapes by which pairs are looked at."""
IMPORTANCE = {"base": 0.35, "arm": 1.0, "hand": 1.6, "fingers": 2.5}
"""How much tighter a group is covered: a bulge of a finger costs grasps, one of the bolted base next to nothing."""
TIGHTER, TIGHTER_ROUNDS = 1.7, 3
"""How much tighter parts are covered that press on each other, and how often."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What the user chose: `chain` and `tool` by link names, joints to `lock`, `quick`, `spheres`, `seed`, `home`."""

    name: str = ""
    base: str = ""
    tip: str = ""
    tool: str = ""
    lock: Mapping[str, float] = field(default_factory=dict[str, float])
    quick: bool = False
    spheres: int = 96
    seed: int = 0
    home: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Made:
    """A body, what is to be known of it, and the shapes (in link frames) that its spheres were fitted to."""

    body: Body
    report: Report
    shapes: dict[str, Mesh]


def build_arm(tree: Tree, policy: Policy, wish: Wish, tell: Tell = lambda _: None) -> Made:
    """The body of one serial arm of `tree`.

    Raises:
        MissingLimits: somebody must state limits first; all of them are listed.
        InvalidSetup: the chain cannot be driven, does not fit the kernel, or has no posture free of self-collision.
        MissingPart: a mesh or library is not there.
    """
    chain = find_chain(tree, base=wish.base, tip=wish.tip, tool=wish.tool, lock=wish.lock)
    if len(chain.joints) > MOST_JOINTS:
        raise InvalidSetup(
            f"joints from {chain.base} to {chain.tip}", got=len(chain.joints), allowed=f"at most {MOST_JOINTS}",
            fix="Hold some still (--lock JOINT=VALUE) or choose a shorter --chain BASE..TIP.",
        )  # fmt: skip
    joints, period, tool_speed = _bounded(tree, chain, policy)
    links, shapes = parts(tree, chain)
    tell(f"{len(joints)} joints, {len(shapes)} parts with shapes; fitting spheres")
    rng = np.random.default_rng([wish.seed, len(links)])
    fits, pairs = _fit_with_room(joints, links, shapes, wish, rng, tell)
    cover = {link.name: fits[link.name].balls for link in links}
    if len(pairs.kept) > MOST_PAIRS:
        raise InvalidSetup("pairs of parts that are kept apart", got=len(pairs.kept), allowed=f"at most {MOST_PAIRS}")
    floor = min((float(mesh.vertices[:, 2].min()) for mesh in shapes.get(chain.base, ())), default=-np.inf)
    home = find_home(joints, links, cover, pairs, wish.home, floor, rng)
    hand = find_hand(tree, chain, policy.robot, keep_tool=bool(wish.tool))
    body = Body(
        name=wish.name or identifier(tree.name), source=tree.source, licence=tree.licence, joints=joints, links=links,
        spheres=spheres_of(cover), self_pairs=pairs, tool=_tool(chain, links, hand),
        gripper=hand.gripper if isinstance(hand, Hand) else no_gripper(hand), home=home.posture,
        tracking=not_identified(), period=period.value, tool_speed=tool_speed,
        gain=curved_gain(joints, links, cover, np.random.default_rng(wish.seed)),
    )  # fmt: skip
    notes = [*tree.notes, f"home {home.provenance}", f"control period {period.value:g} s: {period.provenance}"]
    if chain.locked:
        stand = ", ".join(f"{name} = {value:g}" for name, value in chain.locked.items())
        notes.append(f"joints off the chain are taken to stand still at: {stand}")
    return Made(
        body,
        report_of(links, fits, tuple(notes), quick=wish.quick),
        {name: joined(meshes) for name, meshes in shapes.items()},
    )


def _bounded(tree: Tree, chain: Chain, policy: Policy) -> tuple[tuple[Joint, ...], Bound, Bound]:
    """Joints with every bound, control period and tool speed."""
    missing: list[Missing] = []
    known = {joint.name for joint in tree.joints}
    for name in policy.joints:
        if name not in known:
            tree.joint(name)
    bounds = [joint_bounds(joint, policy, missing) for joint in chain.joints]
    period = whole_bound("period", "s", policy, missing)
    tool_speed = whole_bound("tool_speed", "m/s", policy, missing)
    if missing:
        raise MissingLimits(tree.source, tuple(missing))
    joints = tuple(
        Joint(
            joint.name, vector(offset[:3, 3]), quaternion(offset[:3, :3]), _sure(bound["lower"]), _sure(bound["upper"]),
            _sure(bound["velocity"]), _sure(bound["acceleration"]), bound["jerk"],
            "prismatic" if joint.kind == "prismatic" else "revolute",
        )
        for joint, offset, bound in zip(chain.joints, chain.offsets, bounds, strict=True)
    )  # fmt: skip
    return joints, period, tool_speed


def _sure(bound: Bound | None) -> Bound:
    assert bound is not None
    return bound


def parts(tree: Tree, chain: Chain) -> tuple[tuple[Link, ...], dict[str, list[Mesh]]]:
    """One link of the body for each rigid part: base, arm, what hangs on the last joint, fingers; and its shapes."""
    n = len(chain.joints)
    last = chain.joints[-1].child
    links: dict[str, Link] = {}
    meshes: dict[str, list[Mesh]] = {}
    alone = not any(rider.beyond and not rider.swept and tree.links[rider.link].pieces for rider in chain.riders)
    for rider in chain.riders:
        pieces = tree.links[rider.link].pieces
        if rider.swept:
            name, group = "fingers", "fingers"
        elif rider.frame == n and (rider.beyond or (alone and rider.link == last)):
            name, group = ("hand", "hand")
        else:
            name = chain.base if rider.frame == 0 else chain.joints[rider.frame - 1].child
            group = "base" if rider.frame == 0 else "arm"
        if rider.frame == n or pieces:
            links.setdefault(name, Link(name, rider.frame, group))
        for piece in pieces:
            mesh = piece.load()
            meshes.setdefault(name, []).append(joined([moved(mesh, pose) for pose in rider.poses]))
    ordered = sorted(links.values(), key=lambda link: (link.frame, list(IMPORTANCE).index(link.group)))
    return tuple(ordered), {link.name: meshes[link.name] for link in ordered if link.name in meshes}


def _fit_with_room(
    joints: tuple[Joint, ...], links: tuple[Link, ...], shapes: Mapping[str, list[Mesh]], wish: Wish,
    rng: np.random.Generator, tell: Tell,
) -> tuple[dict[str, Fit], SelfPairs]:  # fmt: skip
    """Cover and pairs; while kept parts are pressed by their own loose spheres, these parts are covered tighter."""
    surfaces = {name: surface_points(joined(meshes), SURFACE, rng) for name, meshes in shapes.items()}
    weights = {link.name: IMPORTANCE[link.group] for link in links}

    def covered() -> tuple[dict[str, Fit], Sampled]:
        fits = _fit(links, shapes, weights, wish)
        cover = {link.name: fits[link.name].balls for link in links}
        tell("sampling pairs of parts")
        count = 3000 if wish.quick else 20_000
        return fits, sampled_pairs(joints, links, cover, surfaces, count=count, rng=rng)

    fits, found = covered()
    for _ in range(TIGHTER_ROUNDS):
        if not found.pressed:
            break
        tell(f"spheres leave no room between {', '.join(sorted(found.pressed))}; fitting these tighter")
        weights |= {name: TIGHTER * weights[name] for name in found.pressed}
        fits, found = covered()
    return fits, found.pairs


def _fit(
    links: tuple[Link, ...], shapes: Mapping[str, list[Mesh]], weights: Mapping[str, float], wish: Wish
) -> dict[str, Fit]:
    if len(links) > MOST_LINKS or wish.spheres > MOST_SPHERES:
        raise InvalidSetup(
            "parts and spheres", got=[len(links), wish.spheres],
            allowed=f"at most {MOST_LINKS} parts and {MOST_SPHERES} spheres",
        )  # fmt: skip
    wanted = {link.name: shapes.get(link.name, []) for link in links}
    return fit_all(wanted, weights, wish.spheres, QUICK if wish.quick else FULL, wish.seed)


def _tool(chain: Chain, links: tuple[Link, ...], hand: Hand | str) -> Tool:
    link = next(link for link in reversed(links) if link.frame == len(chain.joints) and link.group != "fingers")
    pose = hand.tool if isinstance(hand, Hand) else chain.tool
    return Tool(link.name, vector(pose[:3, 3]), quaternion(pose[:3, :3]))


def spheres_of(cover: Mapping[str, Balls]) -> tuple[BodySphere, ...]:
    """The balls of every link as data, 10 µm resolution."""
    return tuple(
        BodySphere(name, vector(centre, 5), round(float(radius), 5))
        for name, balls in cover.items() for centre, radius in zip(balls.centres, balls.radii, strict=True)
    )  # fmt: skip


def no_gripper(why: str) -> Gripper:
    """A hand that skills cannot use, and why."""
    force = Bound(0.0, "N", why)
    return Gripper(Bound(0.0, "m", why), force, force, 0.0, 0.0)


def report_of(links: tuple[Link, ...], fits: Mapping[str, Fit], notes: tuple[str, ...], *, quick: bool) -> Report:
    """What stands beside the body."""
    rows = tuple(
        LinkReport(link.name, link.group, len(fit.balls.radii), fit.parts, fit.coverage, fit.mean, fit.p95, fit.worst)
        for link in links if (fit := fits[link.name]).parts
    )  # fmt: skip
    return Report(rows, notes, "quick" if quick else "full")


def identifier(name: str) -> str:
    """`name` as registries want it: [a-z][a-z0-9_]{0,31}."""
    plain = re.sub(r"[^a-z0-9_]+", "_", name.lower()).strip("_")
    return (plain if plain[:1].isalpha() else f"robot_{plain}".strip("_"))[:32]


def vector(values: Array, digits: int = 12) -> Vector:
    """Three plain floats, without negative zeros."""
    x, y, z = (round(float(value), digits) + 0.0 for value in values)
    return (x, y, z)


UNKNOWN = (
    "not identified: measure how its drive follows and edit `tracking` in body.json, or give "
    "FilterConfig(tracking_error=...)"
)


def not_identified() -> Tracking:
    """No lag and no error, said to be unknown; inspect and doctor count it as missing."""
    return Tracking(0.0, 0.0, 0.0, UNKNOWN)


def is_identified(tracking: Tracking) -> bool:
    """Whether somebody measured it."""
    return tracking.provenance != UNKNOWN
