"""Before anything is flown: both must have the same arm, and what the suite's arm can do is what the filter is told.

robosuite's Panda is a slower arm than a real one. Its joints carry 0.7 to 5 kg m² of armature, so that the wrist's
12 N m cannot reach the data sheet's accelerations; and its fingertips, 10 g each with the inertia of a box of 2.4 m,
meet air that takes 12 N m from a hand that turns at 1 rad/s. Limits that the drive has and the filter does not know of
break its promise: so it is told less speed and acceleration, the same for every task and policy, and how well the arm
follows within them is measured in flights of the same policies, at seeds that are not counted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body, Bound, Tracking
from dualbrain.safety.cbf.filter import SafetyFilter, ToolState
from dualbrain.safety.integration.derating import driven
from dualbrain.simulation.identification.excitation import ASSUMED_ERROR, ASSUMED_LAG, Log
from dualbrain.simulation.identification.tracking_model import fit
from experiments.robots.robosuite.suite_process import Suite
from experiments.robots.robosuite.virtual_environment import FOLDER, digest

Array = NDArray[np.float64]

SPEED = np.full(7, 0.125)
ACCELERATION = np.array([0.25, 0.25, 0.25, 0.25, 0.25, 0.12, 0.12])
"""Shares of the data sheet's limits that the filter is told of: below them the motors do not saturate."""
SAME, SAME_TURN = 1e-3, 5e-3
"""The models must agree this well [m], [rad]."""
POSTURES = 50
DRIVE = "robosuite"


def commissioned(period: float) -> Body:
    """Our Panda with the suite's period and what its motors can do; its tracking is assumed, not known."""
    body = load_body("panda")
    fastest = np.array([joint.velocity.value for joint in body.joints])
    body = driven(body, period=period, speed=(SPEED * fastest).tolist())
    joints = tuple(
        msgspec.structs.replace(
            joint, acceleration=Bound(share * joint.acceleration.value, "rad/s^2", "suite's motors")
        )
        for joint, share in zip(body.joints, ACCELERATION.tolist(), strict=True)
    )
    body = msgspec.structs.replace(body, joints=joints)
    return _with(body, Tracking(ASSUMED_LAG, ASSUMED_ERROR, body.alpha, "assumed while nothing is known", DRIVE))


def measured(suite: Suite, flights: Callable[[Body], list[list[Log]]]) -> Body:
    """The body with the tracking model of what `flights` of the assumed body leave, grouped by seed.

    It is kept beside the environment, for the next process, until something changes that it depends on.
    """
    body = commissioned(suite.open("Lift", 0).period)
    path = FOLDER / f"tracking-{_recipe()}.json"
    if not path.exists():
        said = ", ".join(f"{name} {version}" for name, version in suite.versions.items())
        model = fit(flights(body), body.alpha, body.period, said=f"{said}: filtered flights of seeds not counted")
        path.write_bytes(msgspec.json.format(msgspec.json.encode(model.entry(DRIVE, model.provenance)), indent=1))
    return _with(body, msgspec.json.decode(path.read_bytes(), type=Tracking))


def disagreement(suite: Suite, safety: SafetyFilter, rng: np.random.Generator) -> tuple[float, float]:
    """How far robosuite's grip site is from standing still in our tool frame, over random postures [m], [rad].

    Raises `InvalidSetup` where the two are not the same arm; a task must be open.
    """
    joints = safety.body.joints
    low, high = np.array([j.lower.value for j in joints]), np.array([j.upper.value for j in joints])
    postures = low + (high - low) * rng.random((POSTURES, len(low)))
    return agreed(suite.sites(postures), [safety.tool(q) for q in postures])


def agreed(sites: Array, tools: Sequence[ToolState]) -> tuple[float, float]:
    """The greatest change [m], [rad] of `sites` (k, 12) as seen from k tools; raises `InvalidSetup` for too much."""
    offsets = np.array([tool.rotation.T @ (site[:3] - tool.position) for tool, site in zip(tools, sites, strict=True)])
    turns = np.array([tool.rotation.T @ site[3:].reshape(3, 3) for tool, site in zip(tools, sites, strict=True)])
    apart = float(np.linalg.norm(offsets - offsets[0], axis=1).max())
    turned = float(np.linalg.norm(turns - turns[0], axis=(1, 2)).max() / np.sqrt(2.0))
    if not (apart <= SAME and turned <= SAME_TURN):
        raise InvalidSetup(
            "the suite's arm", got=f"{apart * 1e3:.2f} mm, {turned * 1e3:.2f} mrad from ours",
            allowed=f"at most {SAME * 1e3:g} mm, {SAME_TURN * 1e3:g} mrad",
        )  # fmt: skip
    return apart, turned


def _with(body: Body, tracking: Tracking) -> Body:
    return body.tracked(tracking).driven_by(DRIVE)


def _recipe() -> str:
    """Digest of what the measurement depends on, 12 hex."""
    sources = [path.read_bytes() for path in sorted(Path(__file__).resolve().parent.glob("*.py"))]
    return hashlib.sha256(b"".join([digest().encode(), *sources])).hexdigest()[:12]
