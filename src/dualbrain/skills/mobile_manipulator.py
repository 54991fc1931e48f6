"""The carrier: an arm on a base, so that every skill of either moves its own part while the other part rests.

Base skills see the base alone (x, y, θ; v, ω). Arm skills see the arm alone, in a frame of its own that stands still in
the room while the skill runs: under the arm's first axis, ahead along the base's heading, its height that of what
things stand on. That is how a bolted arm sees its table, so that the arm's skills are the same ones. What either
wants is projected for the whole body: the part that rests may yield, and does not wander by more than one period's
braking.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import matrix, quaternion
from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Place, Scene, SceneObject
from dualbrain.robots.differential_drive import pose
from dualbrain.robots.interface import RobotState
from dualbrain.robots.mobile_manipulator import BASE_GROUP, BASE_JOINTS, BASE_WIDTH, arm_of, base_of
from dualbrain.robots.model import Body
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.skill import Holding, Motion, Nominal, Senses, ToolState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame in the room: `turn` (3, 3) and `origin` (3,) [m]."""

    turn: Array
    origin: Array

    def inward(self, points: Array) -> Array:
        """Points (..., 3) of the room in this frame."""
        return (points - self.origin) @ self.turn

    def scene(self, scene: Scene) -> Scene:
        """The scene as seen from this frame."""
        objects = tuple(self._thing(thing) for thing in scene.objects)
        places = tuple(Place(place.name, self._point(place.position)) for place in scene.places)
        return msgspec.structs.replace(scene, objects=objects, places=places, region=())

    def _thing(self, thing: SceneObject) -> SceneObject:
        turned = quaternion(self.turn.T @ matrix(thing.pose.quaternion))
        velocity = _vector(np.array(thing.velocity) @ self.turn)
        return msgspec.structs.replace(thing, pose=Pose(self._point(thing.pose.position), turned), velocity=velocity)

    def _point(self, position: Vector) -> Vector:
        return _vector(self.inward(np.array(position)))


@dataclass(frozen=True, slots=True)
class Seen:
    """A tool as one part sees it."""

    position: Array
    rotation: Array
    jacobian: Array


class Part:
    """What the local layer lends, cut to one part of the body; keeps what the whole body was last asked to do."""

    def __init__(self, motion: Motion, joints: slice, posture: slice) -> None:
        """`joints` of u and `posture` of q are this part's."""
        self._motion, self.joints, self._posture = motion, joints, posture
        self.frame = Frame(np.eye(3), np.zeros(3))
        self.whole = np.zeros(0)
        """The last projected control of the whole body (n,)."""
        self._state: RobotState | None = None

    def sense(self, state: RobotState) -> RobotState:
        """The state of this part; where the rest of the body is, is kept for what is asked in between."""
        self._state = state
        return self._cut(state)

    def _cut(self, state: RobotState) -> RobotState:
        return replace(state, q=state.q[self._posture], v=state.v[self.joints])

    def _full(self, q: Array) -> Array:
        """The whole configuration with this part at `q`."""
        assert self._state is not None
        whole = self._state.q.copy()
        whole[self._posture] = q
        return whole

    def tool(self, q: Array) -> Seen:
        """The tool with this part at `q`, in this part's frame."""
        return self.seen(self._motion.tool(self._full(q)))

    def seen(self, tool: ToolState) -> Seen:
        """A tool of the room in this part's frame."""
        turn = self.frame.turn
        linear, angular = (turn.T @ tool.jacobian[rows, self.joints] for rows in (slice(0, 3), slice(3, 6)))
        return Seen(self.frame.inward(tool.position), turn.T @ tool.rotation, np.vstack([linear, angular]))

    def spheres(self, q: Array, opening: float) -> tuple[Array, Array, tuple[str, ...]]:
        """This part's own spheres and held ones, in its frame."""
        centres, radii, groups = self._motion.spheres(self._full(q), opening)
        mine = np.array([group != BASE_GROUP for group in groups])
        return self.frame.inward(centres[mine]), radii[mine], tuple(g for g, m in zip(groups, mine, strict=True) if m)

    @property
    def closed(self) -> tuple[SceneObject, ...]:
        """What the site closes, in the world's frame: of use to the part that drives."""
        return self._motion.closed

    def project(self, state: RobotState, u_wish: Array, u_nom_prev: Array, now: float) -> Array:
        """The projection of this part's wish, the rest of the body wishing to stand still."""
        assert self._state is not None
        n = len(self._state.v)
        wish, before = np.zeros(n), np.zeros(n)
        wish[self.joints], before[self.joints] = u_wish, u_nom_prev
        self.whole = self._motion.project(replace(self._state, stamp=state.stamp), wish, before, now)
        return self.whole[self.joints]


class Carrier:
    """A base and its arm, as the skills move them. State: the two parts' own, and which of them is at work."""

    def __init__(self, body: Body, motion: Motion) -> None:
        """Bind to a body and to what the local layer lends; call `sense` before every step of a story."""
        self.body = body
        base, arm = base_of(body), arm_of(body)
        self._base = Part(motion, slice(0, BASE_JOINTS), slice(0, BASE_WIDTH))
        self._arm = Part(motion, slice(BASE_JOINTS, None), slice(BASE_WIDTH, None))
        self.chassis, self.arm = Chassis(base, self._base), Limb(arm, self._arm)
        self._mount = np.array(arm.joints[0].translation)
        self._at_work: Chassis | Limb = self.chassis
        self._told: tuple[Scene, Frame, Scene] | None = None
        self._senses: Senses | None = None

    # --- what the local layer calls -----------------------------------------------------------------------------

    @property
    def holding(self) -> Holding | None:
        """What the hand holds."""
        return self.arm.holding

    @holding.setter
    def holding(self, holding: Holding | None) -> None:
        self.arm.holding = holding

    def sense(self, senses: Senses) -> None:
        """Take in this tick's senses, each part in its own terms."""
        self._senses = senses
        self.chassis.sense(replace(senses, state=self._base.sense(senses.state)))
        state = self._arm.sense(senses.state)
        tool = self._arm.seen(senses.tool)
        self.arm.sense(replace(senses, state=state, tool=tool, scene=self._seen(senses.scene)))

    @property
    def senses(self) -> Senses:
        """This tick's senses of the whole body."""
        assert self._senses is not None
        return self._senses

    def work(self, driving: bool) -> Chassis | Limb:
        """The part that tells the next skill; when it is the arm's turn, its frame is laid anew."""
        self._at_work = self.chassis if driving else self.arm
        if not driving:
            self._arm.frame = self._stand()
            self.sense(self.senses)
        return self._at_work

    def rest(self, phase: str) -> Nominal:
        """One tick of standing still."""
        return self.whole(self._at_work.rest(phase))

    def catch(self, name: str) -> bool:
        """Whether the hand holds `name` from now on, because its fingers press on it."""
        return self.arm.catch(name)

    def reconsider(self, u: Array) -> Array:
        """u_nom (n,) once more, because what φ knows changed since this tick's was made."""
        part = self._part
        self._at_work.reconsider(u[part.joints])
        return part.whole

    def whole(self, nominal: Nominal) -> Nominal:
        """What a part wants, for the whole body; the hand keeps what it has while the base drives."""
        hand = self.arm
        return replace(nominal, u=self._part.whole, opening=hand.opening, force=hand.force, holding=hand.holding)

    # --- inside -------------------------------------------------------------------------------------------------

    @property
    def _part(self) -> Part:
        return self._arm if self._at_work is self.arm else self._base

    def _stand(self) -> Frame:
        """Where the arm stands now: under its first axis, ahead, at the height of what things stand on."""
        turn, position = pose(self.senses.state.q)
        at = np.array(position) + turn @ self._mount
        supports = [thing for thing in self.senses.scene.objects if thing.role == "support"]
        near = min(supports, key=lambda thing: _away(thing, at), default=None)
        height = object_geometry.top(near) if near else float(at[2])
        return Frame(turn, np.array([at[0], at[1], height]))

    def _seen(self, scene: Scene) -> Scene:
        """The scene in the arm's frame; made once for every look."""
        told = self._told
        if told is None or told[0] is not scene or told[1] is not self._arm.frame:
            told = self._told = (scene, self._arm.frame, self._arm.frame.scene(scene))
        return told[2]


def _away(thing: SceneObject, at: Array) -> float:
    """Distance on the floor [m] of `at` from the middle of `thing`."""
    return float(np.hypot(thing.pose.position[0] - at[0], thing.pose.position[1] - at[1]))


def _vector(values: Sequence[float] | Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
