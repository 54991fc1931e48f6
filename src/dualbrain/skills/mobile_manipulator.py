"""Controller of a mobile manipulator: each skill moves the base or the arm, while the other part rests.

Base skills use the base alone (x, y, θ; v, ω). Arm skills use the arm alone, in a local frame that is fixed in the
world while the skill runs: its origin is below the first axis of the arm at the height of the support surface, and its
x-axis is the heading of the base. A fixed arm sees its table in the same way, so that arm skills apply without changes.
The desired control of either part is projected for the whole body. The resting part may yield, and moves by at most the
braking distance of one period.
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
from dualbrain.skills.arm.load_monitor import LoadEvent
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.skill import HeldObject, MotionModel, Nominal, Observation, ToolState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """A frame in the world: `rotation` (3, 3) and `origin` (3,) [m]."""

    rotation: Array
    origin: Array

    def to_local(self, points: Array) -> Array:
        """World points (..., 3) [m] in this frame."""
        return (points - self.origin) @ self.rotation

    def localize_scene(self, scene: Scene) -> Scene:
        """The scene in this frame."""
        objects = tuple(self._localize_object(obj) for obj in scene.objects)
        places = tuple(Place(place.name, self._localize_point(place.position)) for place in scene.places)
        return msgspec.structs.replace(scene, objects=objects, places=places, region=())

    def _localize_object(self, obj: SceneObject) -> SceneObject:
        quaternion = matrix_to_quaternion(self.rotation.T @ quaternion_to_matrix(obj.pose.quaternion))
        velocity = _vector(np.array(obj.velocity) @ self.rotation)
        return msgspec.structs.replace(
            obj, pose=Pose(self._localize_point(obj.pose.position), quaternion), velocity=velocity
        )

    def _localize_point(self, position: Vector) -> Vector:
        return _vector(self.to_local(np.array(position)))


@dataclass(frozen=True, slots=True)
class LocalToolState:
    """A tool in the frame of one part: position (3,) [m], rotation (3, 3), Jacobian (6, n_part)."""

    position: Array
    rotation: Array
    jacobian: Array


class PartMotionModel:
    """Motion model of one part of the robot; stores the last projected control of the whole body."""

    def __init__(self, motion: MotionModel, joints: slice, posture: slice) -> None:
        """`joints` is the slice of u and `posture` the slice of q of this part."""
        self._motion, self.joints, self._configuration = motion, joints, posture
        self.frame = LocalFrame(np.eye(3), np.zeros(3))
        self.whole_body_u = np.zeros(0)
        """The last projected control of the whole body (n,)."""
        self._state: RobotState | None = None

    def observe(self, state: RobotState) -> RobotState:
        """The state of this part; the state of the whole body is stored for later queries."""
        self._state = state
        return self._part_state(state)

    def _part_state(self, state: RobotState) -> RobotState:
        return replace(state, q=state.q[self._configuration], v=state.v[self.joints])

    def _whole_body_q(self, q: Array) -> Array:
        """The whole configuration with `q` for this part."""
        assert self._state is not None
        whole = self._state.q.copy()
        whole[self._configuration] = q
        return whole

    def tool(self, q: Array) -> LocalToolState:
        """The tool with configuration `q` of this part, in the frame of this part."""
        return self.localize_tool(self._motion.tool(self._whole_body_q(q)))

    def localize_tool(self, tool: ToolState) -> LocalToolState:
        """A tool in the world, in the frame of this part."""
        rotation = self.frame.rotation
        linear, angular = (rotation.T @ tool.jacobian[rows, self.joints] for rows in (slice(0, 3), slice(3, 6)))
        position = self.frame.to_local(tool.position)
        return LocalToolState(position, rotation.T @ tool.rotation, np.vstack([linear, angular]))

    def spheres(self, q: Array, opening: float | None) -> tuple[Array, Array, tuple[str, ...]]:
        """Centres, radii and groups of the arm and a grasped object, in the frame of this part."""
        centres, radii, groups = self._motion.spheres(self._whole_body_q(q), opening)
        in_part = np.array([group != BASE_GROUP for group in groups])
        kept = tuple(group for group, kept in zip(groups, in_part, strict=True) if kept)
        return self.frame.to_local(centres[in_part]), radii[in_part], kept

    @property
    def keep_out_boxes(self) -> tuple[SceneObject, ...]:
        """Boxes that the site keeps closed, in the world frame, for the base."""
        return self._motion.keep_out_boxes

    def damped_least_squares(self, J: Array, damping: float, task: Array, free: Array) -> Array:
        """The joint motion of this part that moves the tool by `task`; `J` has the columns of this part."""
        return self._motion.damped_least_squares(J, damping, task, free)

    def project(self, state: RobotState, u_desired: Array, u_nom_prev: Array, now: float) -> Array:
        """Projection of the desired control of this part; the desired control of the other part is zero."""
        assert self._state is not None
        n = len(self._state.v)
        desired, previous = np.zeros(n), np.zeros(n)
        desired[self.joints], previous[self.joints] = u_desired, u_nom_prev
        self.whole_body_u = self._motion.project(replace(self._state, stamp=state.stamp), desired, previous, now)
        return self.whole_body_u[self.joints]


class MobileManipulatorController:
    """Controller of a base and its arm. State: that of both parts, and which of them is active."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Use `motion` for kinematics and projection; call `observe` before every step of a routine."""
        self.robot_model = robot_model
        base, arm = extract_base(robot_model), extract_arm(robot_model)
        self._base_model = PartMotionModel(motion, slice(0, BASE_JOINTS), slice(0, BASE_NQ))
        self._arm_model = PartMotionModel(motion, slice(BASE_JOINTS, None), slice(BASE_NQ, None))
        self.base, self.arm = BaseController(base, self._base_model), ArmController(arm, self._arm_model)
        self._mount = np.array(arm.joints[0].translation)
        self._active: BaseController | ArmController = self.base
        self._local_scene_cache: tuple[Scene, LocalFrame, Scene] | None = None
        self._observation: Observation | None = None

    # --- interface to the control loop --------------------------------------------------------------------------

    @property
    def holding(self) -> HeldObject | None:
        """The object that the hand holds."""
        return self.arm.holding

    @holding.setter
    def holding(self, holding: HeldObject | None) -> None:
        self.arm.holding = holding

    def observe(self, observation: Observation) -> None:
        """Set the observation of this tick, for each part in its own frame."""
        self._observation = observation
        self.base.observe(replace(observation, state=self._base_model.observe(observation.state)))
        state = self._arm_model.observe(observation.state)
        tool = self._arm_model.localize_tool(observation.tool)
        self.arm.observe(replace(observation, state=state, tool=tool, scene=self._local_scene(observation.scene)))
        self.base.holding = self.arm.holding

    @property
    def observation(self) -> Observation:
        """The observation of this tick for the whole body."""
        assert self._observation is not None
        return self._observation

    def activate(self, driving: bool) -> BaseController | ArmController:
        """The controller of the part that executes the next skill; for the arm, its local frame is set here."""
        self._active = self.base if driving else self.arm
        if not driving:
            self._arm_model.frame = self._current_arm_frame()
            self.arm.load_monitor.forget_motion()
            self.observe(self.observation)
        return self._active

    def rest(self, phase: str) -> Nominal:
        """One tick without motion."""
        return self.to_whole_body(self._active.rest(phase))

    def detect_grasp(self, name: str) -> bool:
        """Store `name` as held if the fingers press on it."""
        return self.arm.detect_grasp(name)

    def resume_grasp(self, name: str, opening: float, force: float) -> bool:
        """Continue a grasp, see `ArmController.resume_grasp`."""
        return self.arm.resume_grasp(name, opening, force)

    def check_holding(self) -> None:
        """Monitor the held object, see `ArmController.check_holding`."""
        self.arm.check_holding()

    def take_load_event(self) -> LoadEvent | None:
        """The newest change of the load of the arm, which is then reported."""
        return self.arm.take_load_event()

    def reproject(self, u: Array) -> Array:
        """u_nom (n,) [rad/s] projected again, because the rows known to φ changed within this tick."""
        part = self._active_model
        self._active.reproject(u[part.joints])
        return part.whole_body_u

    def to_whole_body(self, nominal: Nominal) -> Nominal:
        """The control of a part extended to the whole body; the gripper keeps its command while the base drives."""
        hand = self.arm
        return replace(
            nominal, u=self._active_model.whole_body_u, opening=hand.opening, force=hand.force, holding=hand.holding
        )

    # --- internals ----------------------------------------------------------------------------------------------

    @property
    def _active_model(self) -> PartMotionModel:
        return self._arm_model if self._active is self.arm else self._base_model

    def _current_arm_frame(self) -> LocalFrame:
        """The local frame: below the first axis of the arm, along the heading, at the height of the nearest support."""
        rotation, position = base_pose(self.observation.state.q)
        origin = np.array(position) + rotation @ self._mount
        nearest = object_geometry.nearest_support(self.observation.scene, float(origin[0]), float(origin[1]))
        height = object_geometry.top_height(nearest) if nearest else float(origin[2])
        return LocalFrame(rotation, np.array([origin[0], origin[1], height]))

    def _local_scene(self, scene: Scene) -> Scene:
        """The scene in the arm's frame, computed once per scene and frame."""
        cached, frame = self._local_scene_cache, self._arm_model.frame
        if cached is None or cached[0] is not scene or cached[1] is not frame:
            cached = self._local_scene_cache = (scene, frame, frame.localize_scene(scene))
        return cached[2]


def _vector(values: Sequence[float] | Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
