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

from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Place, Scene, SceneObject
from dualbrain.robots.differential_drive import base_pose
from dualbrain.robots.interface import RobotState
from dualbrain.robots.mobile_manipulator import BASE_GROUP, BASE_JOINTS, BASE_NQ, extract_arm, extract_base
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.skill import HeldObject, MotionModel, Nominal, Observation, ToolState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """A frame in the room: `turn` (3, 3) and `origin` (3,) [m]."""

    rotation: Array
    origin: Array

    def to_local(self, points: Array) -> Array:
        """Points (..., 3) of the room in this frame."""
        return (points - self.origin) @ self.rotation

    def localize_scene(self, scene: Scene) -> Scene:
        """The scene as seen from this frame."""
        objects = tuple(self._localize_object(thing) for thing in scene.objects)
        places = tuple(Place(place.name, self._localize_point(place.position)) for place in scene.places)
        return msgspec.structs.replace(scene, objects=objects, places=places, region=())

    def _localize_object(self, obj: SceneObject) -> SceneObject:
        turned = matrix_to_quaternion(self.rotation.T @ quaternion_to_matrix(obj.pose.quaternion))
        velocity = _vector(np.array(obj.velocity) @ self.rotation)
        return msgspec.structs.replace(
            obj, pose=Pose(self._localize_point(obj.pose.position), turned), velocity=velocity
        )

    def _localize_point(self, position: Vector) -> Vector:
        return _vector(self.to_local(np.array(position)))


@dataclass(frozen=True, slots=True)
class LocalToolState:
    """A tool as one part sees it."""

    position: Array
    rotation: Array
    jacobian: Array


class PartMotionModel:
    """What the local layer lends, cut to one part of the body; keeps what the whole body was last asked to do."""

    def __init__(self, motion: MotionModel, joints: slice, posture: slice) -> None:
        """`joints` of u and `posture` of q are this part's."""
        self._motion, self.joints, self._configuration = motion, joints, posture
        self.frame = LocalFrame(np.eye(3), np.zeros(3))
        self.whole_body_u = np.zeros(0)
        """The last projected control of the whole body (n,)."""
        self._state: RobotState | None = None

    def observe(self, state: RobotState) -> RobotState:
        """The state of this part; where the rest of the body is, is kept for what is asked in between."""
        self._state = state
        return self._part_state(state)

    def _part_state(self, state: RobotState) -> RobotState:
        return replace(state, q=state.q[self._configuration], v=state.v[self.joints])

    def _whole_body_q(self, q: Array) -> Array:
        """The whole configuration with this part at `q`."""
        assert self._state is not None
        whole = self._state.q.copy()
        whole[self._configuration] = q
        return whole

    def tool(self, q: Array) -> LocalToolState:
        """The tool with this part at `q`, in this part's frame."""
        return self.localize_tool(self._motion.tool(self._whole_body_q(q)))

    def localize_tool(self, tool: ToolState) -> LocalToolState:
        """A tool of the room in this part's frame."""
        turn = self.frame.rotation
        linear, angular = (turn.T @ tool.jacobian[rows, self.joints] for rows in (slice(0, 3), slice(3, 6)))
        return LocalToolState(self.frame.to_local(tool.position), turn.T @ tool.rotation, np.vstack([linear, angular]))

    def spheres(self, q: Array, opening: float) -> tuple[Array, Array, tuple[str, ...]]:
        """This part's own spheres and held ones, in its frame."""
        centres, radii, groups = self._motion.spheres(self._whole_body_q(q), opening)
        mine = np.array([group != BASE_GROUP for group in groups])
        return self.frame.to_local(centres[mine]), radii[mine], tuple(g for g, m in zip(groups, mine, strict=True) if m)

    @property
    def keep_out_boxes(self) -> tuple[SceneObject, ...]:
        """What the site closes, in the world's frame: of use to the part that drives."""
        return self._motion.keep_out_boxes

    def project(self, state: RobotState, u_desired: Array, u_nom_prev: Array, now: float) -> Array:
        """The projection of this part's wish, the rest of the body wishing to stand still."""
        assert self._state is not None
        n = len(self._state.v)
        wish, before = np.zeros(n), np.zeros(n)
        wish[self.joints], before[self.joints] = u_desired, u_nom_prev
        self.whole_body_u = self._motion.project(replace(self._state, stamp=state.stamp), wish, before, now)
        return self.whole_body_u[self.joints]


class MobileManipulatorController:
    """A base and its arm, as the skills move them. State: the two parts' own, and which of them is at work."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Bind to a body and to what the local layer lends; call `sense` before every step of a story."""
        self.robot_model = robot_model
        base, arm = extract_base(robot_model), extract_arm(robot_model)
        self._base_model = PartMotionModel(motion, slice(0, BASE_JOINTS), slice(0, BASE_NQ))
        self._arm_model = PartMotionModel(motion, slice(BASE_JOINTS, None), slice(BASE_NQ, None))
        self.base, self.arm = BaseController(base, self._base_model), ArmController(arm, self._arm_model)
        self._mount = np.array(arm.joints[0].translation)
        self._active: BaseController | ArmController = self.base
        self._local_scene_cache: tuple[Scene, LocalFrame, Scene] | None = None
        self._observation: Observation | None = None

    # --- what the local layer calls -----------------------------------------------------------------------------

    @property
    def holding(self) -> HeldObject | None:
        """What the hand holds."""
        return self.arm.holding

    @holding.setter
    def holding(self, holding: HeldObject | None) -> None:
        self.arm.holding = holding

    def observe(self, observation: Observation) -> None:
        """Take in this tick's senses, each part in its own terms."""
        self._observation = observation
        self.base.observe(replace(observation, state=self._base_model.observe(observation.state)))
        state = self._arm_model.observe(observation.state)
        tool = self._arm_model.localize_tool(observation.tool)
        self.arm.observe(replace(observation, state=state, tool=tool, scene=self._local_scene(observation.scene)))

    @property
    def observation(self) -> Observation:
        """This tick's senses of the whole body."""
        assert self._observation is not None
        return self._observation

    def activate(self, driving: bool) -> BaseController | ArmController:
        """The part that tells the next skill; when it is the arm's turn, its frame is laid anew."""
        self._active = self.base if driving else self.arm
        if not driving:
            self._arm_model.frame = self._current_arm_frame()
            self.observe(self.observation)
        return self._active

    def rest(self, phase: str) -> Nominal:
        """One tick of standing still."""
        return self.to_whole_body(self._active.rest(phase))

    def detect_grasp(self, name: str) -> bool:
        """Whether the hand holds `name` from now on, because its fingers press on it."""
        return self.arm.detect_grasp(name)

    def reproject(self, u: Array) -> Array:
        """u_nom (n,) once more, because what φ knows changed since this tick's was made."""
        part = self._active_model
        self._active.reproject(u[part.joints])
        return part.whole_body_u

    def to_whole_body(self, nominal: Nominal) -> Nominal:
        """What a part wants, for the whole body; the hand keeps what it has while the base drives."""
        hand = self.arm
        return replace(
            nominal, u=self._active_model.whole_body_u, opening=hand.opening, force=hand.force, holding=hand.holding
        )

    # --- inside -------------------------------------------------------------------------------------------------

    @property
    def _active_model(self) -> PartMotionModel:
        return self._arm_model if self._active is self.arm else self._base_model

    def _current_arm_frame(self) -> LocalFrame:
        """Where the arm stands now: under its first axis, ahead, at the height of what things stand on."""
        turn, position = base_pose(self.observation.state.q)
        at = np.array(position) + turn @ self._mount
        supports = [thing for thing in self.observation.scene.objects if thing.role == "support"]
        near = min(supports, key=lambda thing: _floor_distance(thing, at), default=None)
        height = object_geometry.top_height(near) if near else float(at[2])
        return LocalFrame(turn, np.array([at[0], at[1], height]))

    def _local_scene(self, scene: Scene) -> Scene:
        """The scene in the arm's frame; made once for every look."""
        told = self._local_scene_cache
        if told is None or told[0] is not scene or told[1] is not self._arm_model.frame:
            told = self._local_scene_cache = (scene, self._arm_model.frame, self._arm_model.frame.localize_scene(scene))
        return told[2]


def _floor_distance(obj: SceneObject, at: Array) -> float:
    """Distance on the floor [m] of `at` from the middle of `thing`."""
    return float(np.hypot(obj.pose.position[0] - at[0], obj.pose.position[1] - at[1]))


def _vector(values: Sequence[float] | Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
