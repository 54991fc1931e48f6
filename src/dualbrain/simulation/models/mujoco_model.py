"""Loads the MuJoCo model of a robot: from the user's file, from a local copy of Menagerie, or the built-in model.

Nothing is downloaded. Every model of an arm of n joints follows one convention: bodies `link0`..`link{n}`, `hand`,
`left_finger`, `right_finger`; velocity actuators `actuator1`..`actuator{n}` in group 1, the finger servo `gripper` in
group 2, touch sensors `left_touch` and `right_touch`, site `tcp`, gravity compensation on every moving body. A mobile
base is one body `link0` with slide joints `x`, `y` and a hinge joint `yaw`, each with a velocity actuator of its name,
and the site `tcp`. A mobile manipulator is an arm whose `link0` is mounted on a body `platform` with those joints.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import mujoco

from dualbrain.core.geometry.shapes import Vector
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.builtin.mobile_panda import ARM_MOUNT_POSITION
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.robots.mobile_manipulator import BASE_JOINTS
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.models.menagerie import adapt_panda, find_menagerie_file
from dualbrain.simulation.models.visual_meshes import add_visual_meshes, find_mesh_folder

MODEL_FILES = {
    "panda": "panda",
    "fr3": "panda",
    "ur5e": "ur5e",
    "ur5e_lean": "ur5e",
    "base": "base",
    "mobile_panda": "platform",
}
"""File of the built-in model of each robot; the joint limits are those of the robot model."""
MOUNTED_ARMS = {"mobile_panda": ("panda", ARM_MOUNT_POSITION)}
"""The arm of each mobile manipulator, and its mounting position on the platform [m]."""
PLATFORM_BODY = "platform"
"""Name of the body of a mobile manipulator's base."""

BASE_JOINT_NAMES = ("x", "y", "yaw")


def n_arm_joints(robot_model: RobotModel) -> int:
    """Number of joints of the arm of `robot_model`."""
    return robot_model.n - BASE_JOINTS if robot_model.is_mobile else robot_model.n


def required_elements(n: int) -> dict[str, tuple[str, ...]]:
    """Names of the elements that the model of an arm of `n` joints must have, by kind; for n = 0, of a mobile base."""
    if n == 0:
        return {"body": ("link0",), "joint": BASE_JOINT_NAMES, "actuator": BASE_JOINT_NAMES, "site": ("tcp",)}
    return {
        "body": (*(f"link{i}" for i in range(n + 1)), "hand", "left_finger", "right_finger"),
        "joint": (*(f"joint{i}" for i in range(1, n + 1)), "finger_joint1", "finger_joint2"),
        "actuator": (*(f"actuator{i}" for i in range(1, n + 1)), "gripper"),
        "sensor": ("left_touch", "right_touch"),
        "site": ("tcp",),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class MujocoModel:
    """A robot that can be attached to a scene: editable `spec`, description of its `source`, visual meshes or not.

    A mobile manipulator also has a `mounted_arm` at `mount_position` [m].
    """

    name: str
    spec: mujoco.MjSpec
    source: str
    has_visuals: bool
    mounted_arm: MujocoModel | None = None
    mount_position: Vector = (0.0, 0.0, 0.0)

    @property
    def root(self) -> mujoco.MjsBody:
        """The root body of the robot."""
        return self.spec.body(PLATFORM_BODY if self.mounted_arm else "link0")


def load_mujoco_model(
    name: str, *, path: Path | None = None, menagerie: Path | None = None, visuals: bool = False
) -> MujocoModel:
    """The MuJoCo model of the robot `name`, from the first available source.

    `path` is a MJCF file of the user that follows the convention of this module. `menagerie` is a checkout of MuJoCo
    Menagerie or a filled cache folder of its downloader (the caller reads MENAGERIE_ROOT). Without either, the built-in
    model is used. `visuals` adds surface meshes, which do not change the physics. Raises `UnknownNameError` for an
    unknown robot and `ConfigurationError` for a robot of the user, or a file that cannot be loaded or lacks an element.
    """
    if name not in MODEL_FILES and (name in BUILTIN_ROBOTS or Path(name).exists()):
        raise ConfigurationError.stating(
            f"The robot {name} cannot be simulated: only {', '.join(MODEL_FILES)} have a MuJoCo model.",
            fix="Its contracts can be checked (`dualbrain check`, `schema`), and `SafetyFilter` filters its commands.",
        )
    if name not in MODEL_FILES:
        raise UnknownNameError("robot model", name, tuple(MODEL_FILES))
    if path is None and name in MOUNTED_ARMS:
        return _load_mobile_manipulator(name, menagerie=menagerie, visuals=visuals)
    if path is not None:
        spec, source, has_meshes = _load_user_file(path), f"file {path.name}", True
    elif name == "panda" and (found := find_menagerie_file(menagerie)) is not None:
        spec, source, has_meshes = adapt_panda(mujoco.MjSpec.from_file(str(found))), "MuJoCo Menagerie", True
    else:
        spec, source, has_meshes = _load_built_in(name), "built-in", False
    _check_and_set_limits(spec, source, load_robot(name))
    if not visuals:
        strip_visuals(spec)
    elif name == "panda" and not has_meshes and (folder := find_mesh_folder()) is not None:
        add_visual_meshes(spec, folder)
        has_meshes, source = True, f"{source}, visual meshes from example-robot-data"
    return MujocoModel(name=name, spec=spec, source=source, has_visuals=visuals and has_meshes)


def _load_mobile_manipulator(name: str, *, menagerie: Path | None, visuals: bool) -> MujocoModel:
    """A built-in platform and the arm that is mounted on it."""
    arm_name, mount_position = MOUNTED_ARMS[name]
    arm, spec = load_mujoco_model(arm_name, menagerie=menagerie, visuals=visuals), _load_built_in(name)
    source = f"built-in platform; arm: {arm.source}"
    _require_elements(spec, source, {"body": (PLATFORM_BODY,), "joint": BASE_JOINT_NAMES, "actuator": BASE_JOINT_NAMES})
    return MujocoModel(
        name=name,
        spec=spec,
        source=source,
        has_visuals=arm.has_visuals,
        mounted_arm=arm,
        mount_position=mount_position,
    )


def strip_visuals(spec: mujoco.MjSpec) -> None:
    """Delete the visual geoms (group 2) of `spec`, for runs without rendering."""
    for geom in [geom for geom in spec.geoms if geom.group == 2]:
        spec.delete(geom)


def _load_built_in(name: str) -> mujoco.MjSpec:
    text = resources.files("dualbrain.simulation.models").joinpath("mjcf", f"{MODEL_FILES[name]}.xml").read_text()
    return mujoco.MjSpec.from_string(text)


def _load_user_file(path: Path) -> mujoco.MjSpec:
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        sentence = f"MuJoCo cannot load the robot model file: {error}."
        raise ConfigurationError.stating(sentence, fix=f"Correct the MJCF file: {path}") from error


def _check_and_set_limits(spec: mujoco.MjSpec, source: str, robot_model: RobotModel) -> None:
    """Check that every required element exists, and set the joint ranges of the robot model."""
    _require_elements(spec, source, required_elements(n_arm_joints(robot_model)))
    for index, joint in enumerate(() if robot_model.is_mobile else robot_model.joints, start=1):
        spec.joint(f"joint{index}").range = [joint.lower.value, joint.upper.value]


def _require_elements(spec: mujoco.MjSpec, source: str, elements: dict[str, tuple[str, ...]]) -> None:
    for kind, names in elements.items():
        missing = [name for name in names if getattr(spec, kind)(name) is None]
        if missing:
            raise ConfigurationError(
                f"robot model ({source})", got=f"no {kind} {', '.join(missing)}", allowed=f"{kind}s {', '.join(names)}"
            )
