"""Builds the `RobotModel` of an arm from its description: chain, limits, sphere cover, pairs, home posture, report."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.mesh_primitives import apply_pose, concatenate_meshes
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.polytope import sample_surface
from dualbrain.robots.collision_model.self_collision_sampling import SampledPairs, sample_pairs
from dualbrain.robots.collision_model.sphere_budget import FULL, QUICK, LinkFit, fit_links
from dualbrain.robots.collision_model.swept_volume import swept_mesh
from dualbrain.robots.importer.cbf_gain import curvature_limited_gain
from dualbrain.robots.importer.gripper import DetectedGripper, detect_gripper
from dualbrain.robots.importer.home_posture import find_home_posture
from dualbrain.robots.importer.kinematic_chain import KinematicChain, find_chain
from dualbrain.robots.importer.kinematic_tree import KinematicTree
from dualbrain.robots.importer.report import ImportReport, LinkReport
from dualbrain.robots.importer.required_limits import (
    LimitPolicy,
    MissingLimit,
    MissingLimitsError,
    joint_bounds,
    refuse_unused_limits,
    robot_bound,
)
from dualbrain.robots.model import (
    Bound,
    CollisionSphere,
    Gripper,
    Joint,
    Link,
    RobotModel,
    SelfCollisionPairs,
    Tool,
    TrackingErrorModel,
    Vector,
)

Array = NDArray[np.float64]
ProgressReporter = Callable[[str], None]

MAX_JOINTS, MAX_SPHERES, MAX_LINKS, MAX_PAIRS = 16, 232, 31, 320
"""Capacity of the largest build of the kernel (CMakeLists.txt; a test compares them)."""
N_SURFACE_POINTS = 600
"""Number of surface points of each link for the choice of pairs."""
COVER_WEIGHTS = {"base": 0.35, "arm": 1.0, "hand": 1.6, "fingers": 2.5}
"""Weight of the excess by link group: an excess on a finger prevents grasps, one on a fixed base hardly matters."""
TIGHTENING_FACTOR, MAX_TIGHTENING_ROUNDS = 1.7, 3
"""Factor on the weights of congested links, and the maximum number of new fits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """Options of the user: base, tip and tool links (by name, "" to choose them), locked joints, and fit settings.

    `lock` maps joints to constant values [rad or m]; `home` is the home posture, found automatically if it is None.
    `weights` are those of the excess by link group.
    """

    name: str = ""
    base: str = ""
    tip: str = ""
    tool: str = ""
    lock: Mapping[str, float] = field(default_factory=dict[str, float])
    quick: bool = False
    sphere_budget: int = 96
    seed: int = 0
    home: tuple[float, ...] | None = None
    weights: Mapping[str, float] = field(default_factory=lambda: COVER_WEIGHTS)


@dataclass(frozen=True, slots=True)
class ImportResult:
    """A robot model, its report, and the shapes (in link frames) to which its spheres were fitted."""

    robot_model: RobotModel
    report: ImportReport
    shapes: dict[str, Mesh]


def build_arm(
    tree: KinematicTree, policy: LimitPolicy, options: ImportOptions, report_progress: ProgressReporter = lambda _: None
) -> ImportResult:
    """The robot model of one serial arm of `tree`.

    Raises:
        MissingLimitsError: Neither the description nor `policy` states a limit; all missing limits are listed.
        ConfigurationError: The chain cannot be driven, exceeds the capacity of the kernel, has no posture without
            self-collision, or a limit is stated that no joint of the chain keeps.
        UnknownNameError: A limit of a joint that does not exist is stated.
        MissingDependencyError: A mesh file or a library does not exist.
    """
    chain = find_chain(tree, base=options.base, tip=options.tip, tool=options.tool, lock=options.lock)
    if len(chain.joints) > MAX_JOINTS:
        raise ConfigurationError(
            f"joints from {chain.base} to {chain.tip}",
            got=len(chain.joints),
            allowed=f"at most {MAX_JOINTS}",
            fix="Lock some joints (--lock JOINT=VALUE) or choose a shorter chain (--chain BASE..TIP).",
        )
    joints, period, tool_speed = _joint_limits(tree, chain, policy)
    links, shapes = rigid_parts(tree, chain)
    report_progress(f"{len(joints)} joints, {len(shapes)} links with shapes; fitting spheres")
    rng = np.random.default_rng([options.seed, len(links)])
    fits, pairs = _fit_with_clearance(joints, links, shapes, options, rng, report_progress)
    cover = {link.name: fits[link.name].spheres for link in links}
    if len(pairs.kept) > MAX_PAIRS:
        raise ConfigurationError("kept self-collision pairs", got=len(pairs.kept), allowed=f"at most {MAX_PAIRS}")
    base = next((link.name for link in links if link.frame == 0), "")
    floor = min((float(mesh.vertices[:, 2].min()) for mesh in shapes.get(base, ())), default=-np.inf)
    home = find_home_posture(joints, links, cover, pairs, options.home, floor, rng)
    detected = detect_gripper(tree, chain, policy.robot, keep_tool=bool(options.tool))
    robot_model = RobotModel(
        name=options.name or to_identifier(tree.name),
        source=tree.source,
        licence=tree.licence,
        joints=joints,
        links=links,
        spheres=collision_spheres(cover),
        self_pairs=pairs,
        tool=_tool_frame(chain, links, detected),
        gripper=detected.gripper if isinstance(detected, DetectedGripper) else no_gripper(detected),
        home=home.posture,
        tracking=unidentified_tracking(),
        period=period.value,
        tool_speed=tool_speed,
        gain=curvature_limited_gain(joints, links, cover, np.random.default_rng(options.seed)),
    )
    notes = [*tree.notes, f"home {home.provenance}", f"control period {period.value:g} s: {period.provenance}"]
    if chain.locked:
        values = ", ".join(f"{name} = {value:g}" for name, value in chain.locked.items())
        notes.append(f"joints outside the chain are assumed to be fixed at: {values}")
    return ImportResult(
        robot_model,
        make_report(links, fits, tuple(notes), quick=options.quick),
        {name: concatenate_meshes(meshes) for name, meshes in shapes.items()},
    )


def _joint_limits(
    tree: KinematicTree, chain: KinematicChain, policy: LimitPolicy
) -> tuple[tuple[Joint, ...], Bound, Bound]:
    """The joints with all bounds, the control period and the limit of the tool speed."""
    missing: list[MissingLimit] = []
    reason = "an arm has no base that turns"
    refuse_unused_limits(policy.robot, {"turn": reason, "turn_acceleration": reason})
    driven = {joint.name for joint in chain.joints}
    for name, limits in policy.by_joint.items():
        if tree.joint(name).name not in driven:
            fixed = f"the chain from {chain.base} to {chain.tip} does not drive this joint"
            refuse_unused_limits(limits, dict.fromkeys(limits, fixed), f" of {name!r}")
    bounds = [joint_bounds(joint, policy, missing) for joint in chain.joints]
    period = robot_bound("period", "s", policy, missing)
    tool_speed = robot_bound("tool_speed", "m/s", policy, missing)
    if missing:
        raise MissingLimitsError(tree.source, tuple(missing))
    joints = tuple(
        Joint(
            name=joint.name,
            translation=to_vector(offset[:3, 3]),
            quaternion=matrix_to_quaternion(offset[:3, :3]),
            lower=_require_bound(bound["lower"]),
            upper=_require_bound(bound["upper"]),
            velocity=_require_bound(bound["velocity"]),
            acceleration=_require_bound(bound["acceleration"]),
            jerk=bound["jerk"],
            kind="prismatic" if joint.kind == "prismatic" else "revolute",
        )
        for joint, offset, bound in zip(chain.joints, chain.offsets, bounds, strict=True)
    )
    return joints, period, tool_speed


def _require_bound(bound: Bound | None) -> Bound:
    assert bound is not None
    return bound


def rigid_parts(tree: KinematicTree, chain: KinematicChain) -> tuple[tuple[Link, ...], dict[str, list[Mesh]]]:
    """The links of the robot model (base, arm, hand, fingers), and the meshes of each link in its frame.

    All links of the description that are rigidly connected form one link; all fingers together form one link. A link
    of the base or arm that the description calls as another group ("hand") is renamed ("hand_link"): a permit or plane
    for the group would hold for it.
    """
    n = len(chain.joints)
    last = chain.joints[-1].child
    links: dict[str, Link] = {}
    meshes: dict[str, list[Mesh]] = {}
    no_hand_shapes = not any(
        segment.is_past_last_joint and not segment.is_swept and tree.links[segment.link].shapes
        for segment in chain.segments
    )
    for segment in chain.segments:
        shapes = tree.links[segment.link].shapes
        if segment.is_swept:
            name, group = "fingers", "fingers"
        elif segment.frame == n and (segment.is_past_last_joint or (no_hand_shapes and segment.link == last)):
            name, group = ("hand", "hand")
        else:
            name = chain.base if segment.frame == 0 else chain.joints[segment.frame - 1].child
            group = "base" if segment.frame == 0 else "arm"
            name = _unreserved_name(name, group, tree)
        if segment.frame == n or shapes:
            links.setdefault(name, Link(name=name, frame=segment.frame, group=group))
        for shape in shapes:
            mesh = shape.load_mesh()
            moved = swept_mesh(mesh, segment.sweep) if segment.is_swept else apply_pose(mesh, segment.poses[0])
            meshes.setdefault(name, []).append(moved)
    ordered = sorted(links.values(), key=lambda link: (link.frame, list(COVER_WEIGHTS).index(link.group)))
    return tuple(ordered), {link.name: meshes[link.name] for link in ordered if link.name in meshes}


def _unreserved_name(name: str, group: str, tree: KinematicTree) -> str:
    """`name`, or one that is neither the name of another group nor that of a link of the description."""
    if name == group or name not in (*COVER_WEIGHTS, "held"):
        return name
    while name in (*tree.links, *COVER_WEIGHTS):
        name += "_link"
    return name


def _fit_with_clearance(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    shapes: Mapping[str, list[Mesh]],
    options: ImportOptions,
    rng: np.random.Generator,
    report_progress: ProgressReporter,
) -> tuple[dict[str, LinkFit], SelfCollisionPairs]:
    """Sphere cover and pairs; links of congested pairs are covered again with a higher weight."""
    surfaces = {
        name: sample_surface(concatenate_meshes(meshes), N_SURFACE_POINTS, rng) for name, meshes in shapes.items()
    }
    weights = {link.name: options.weights[link.group] for link in links}

    def fit() -> tuple[dict[str, LinkFit], SampledPairs]:
        fits = _fit_spheres(links, shapes, weights, options)
        cover = {link.name: fits[link.name].spheres for link in links}
        report_progress("sampling pairs of links")
        n_samples = 3000 if options.quick else 20_000
        return fits, sample_pairs(joints, links, cover, surfaces, n_samples=n_samples, rng=rng)

    fits, sampled = fit()
    for _ in range(MAX_TIGHTENING_ROUNDS):
        if not sampled.congested_links:
            break
        names = ", ".join(sorted(sampled.congested_links))
        report_progress(f"the spheres leave no room between {names}; fitting these links more tightly")
        weights |= {name: TIGHTENING_FACTOR * weights[name] for name in sampled.congested_links}
        fits, sampled = fit()
    return fits, sampled.pairs


def _fit_spheres(
    links: tuple[Link, ...], shapes: Mapping[str, list[Mesh]], weights: Mapping[str, float], options: ImportOptions
) -> dict[str, LinkFit]:
    if len(links) > MAX_LINKS or options.sphere_budget > MAX_SPHERES:
        raise ConfigurationError(
            "links and spheres",
            got=[len(links), options.sphere_budget],
            allowed=f"at most {MAX_LINKS} links and {MAX_SPHERES} spheres",
        )
    meshes = {link.name: shapes.get(link.name, []) for link in links}
    return fit_links(meshes, weights, options.sphere_budget, QUICK if options.quick else FULL, options.seed)


def _tool_frame(chain: KinematicChain, links: tuple[Link, ...], detected: DetectedGripper | str) -> Tool:
    link = next(link for link in reversed(links) if link.frame == len(chain.joints) and link.group != "fingers")
    pose = detected.tool if isinstance(detected, DetectedGripper) else chain.tool
    return Tool(link.name, to_vector(pose[:3, 3]), matrix_to_quaternion(pose[:3, :3]))


def collision_spheres(cover: Mapping[str, SphereSet]) -> tuple[CollisionSphere, ...]:
    """The spheres of every link as records, rounded to 10 µm."""
    return tuple(
        CollisionSphere(name, to_vector(centre, 5), round(float(radius), 5))
        for name, spheres in cover.items()
        for centre, radius in zip(spheres.centres, spheres.radii, strict=True)
    )


def no_gripper(reason: str) -> Gripper:
    """A gripper that no skill can use, with the reason as its provenance."""
    force = Bound(0.0, "N", reason)
    return Gripper(
        opening=Bound(0.0, "m", reason), force=force, force_min=force, pad_below_tool=0.0, finger_thickness=0.0
    )


def make_report(
    links: tuple[Link, ...], fits: Mapping[str, LinkFit], notes: tuple[str, ...], *, quick: bool
) -> ImportReport:
    """The report of an import: one row per link with shapes, and the notes."""
    rows = tuple(
        LinkReport(
            link=link.name,
            group=link.group,
            spheres=len(fit.spheres.radii),
            parts=fit.n_parts,
            coverage=fit.coverage,
            mean=fit.mean,
            p95=fit.p95,
            worst=fit.worst,
        )
        for link in links
        if (fit := fits[link.name]).n_parts
    )
    return ImportReport(rows, notes, "quick" if quick else "full")


def to_identifier(name: str) -> str:
    """`name` as an identifier of a skill registry: [a-z][a-z0-9_]{0,31}."""
    identifier = re.sub(r"[^a-z0-9_]+", "_", name.lower()).strip("_")
    return (identifier if identifier[:1].isalpha() else f"robot_{identifier}".strip("_"))[:32]


def to_vector(values: Array, digits: int = 12) -> Vector:
    """Three Python floats, rounded to `digits` decimals, without negative zeros."""
    x, y, z = (round(float(value), digits) + 0.0 for value in values)
    return (x, y, z)


NOT_IDENTIFIED = (
    "not identified: measure how its drive follows and edit `tracking` in body.json, or give "
    "FilterConfig(tracking_error=...)"
)
"""Provenance of a tracking-error model that was not identified; stored in robot folders."""


def unidentified_tracking() -> TrackingErrorModel:
    """A tracking-error model without lag and error, marked as not identified: `inspect` reports it as missing."""
    return TrackingErrorModel(lag=0.0, position_error=0.0, rate=0.0, provenance=NOT_IDENTIFIED)


def is_identified(tracking: TrackingErrorModel) -> bool:
    """Whether `tracking` was identified by a measurement."""
    return tracking.provenance != NOT_IDENTIFIED
