"""Check of `/robot_description` (URDF) against the robot model: the file it was imported from, or its kinematics."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.untrusted.bounded_file import read_regular_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.robots.assets.safe_xml import MAX_DESCRIPTION_BYTES, parse_xml
from dualbrain.robots.loader import MAX_FILE_BYTES
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

DIRECTION_TOLERANCE, DISTANCE_TOLERANCE = 1e-3, 1e-3
"""Angle [rad] and distance [m] of two joint axes that count as the same."""
POSTURES = 6
"""Random postures at which the joint axes are compared."""
KINDS = {"revolute": ("revolute", "continuous"), "prismatic": ("prismatic",)}
"""Types of joints in a URDF by their kind in the robot model."""
LIMIT_ROUNDING = 1e-3
"""Share by which a limit of the description may be below that of the robot model."""


class _Record(msgspec.Struct, frozen=True):
    """The entry of an import record that is read here."""

    sha256: str


def source_digest(folder: Path) -> str:
    """SHA-256 of the description from which `folder` was imported; "" without a readable import record."""
    data = read_regular_file(folder / "recipe.json", MAX_FILE_BYTES)
    if not isinstance(data, bytes):
        return ""
    try:
        return msgspec.json.decode(data, type=_Record).sha256
    except DECODE_ERRORS:
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class UrdfJoint:
    """A joint of a URDF: its links, its pose in the parent link, its axis, and the limits that are stated."""

    name: str
    kind: str
    parent: str
    child: str
    rotation: Array
    translation: Array
    axis: Array
    limits: dict[str, float]


class DescriptionCheck:
    """Whether the robot description on a topic is that of the robot model.

    `problem`: why the arm must rest, with a remedy; `warning`: a limit of the description that is below that of the
    model, or that an imported robot has no import record to compare with; `base_frame`: the link whose frame is that of
    the robot model.
    """

    def __init__(
        self,
        robot_model: RobotModel,
        names: tuple[str, ...],
        *,
        mode: Literal["exact", "kinematics", "none"],
        digest: str | None = None,
        base_frame: str = "",
    ) -> None:
        """Check for `robot_model` with joints called `names` in the description.

        `digest` is the SHA-256 of the file that the model was imported from; the mode "exact" then accepts this file
        only. It is "" for an imported robot whose file is unknown, of which the kinematics are checked with a warning,
        and None for a packaged robot. `base_frame`, if it is given, must be a link whose frame is that of the robot
        model.
        """
        self._model, self._names, self._mode, self._digest, self._base = robot_model, names, mode, digest, base_frame
        self.base_frame = base_frame
        self._unknown_source = (
            f"The robot folder of {robot_model.name} has no readable recipe.json with the SHA-256 of the imported "
            "description, so only kinematics and limits are compared with the robot description. Remedy: import the "
            'description with `dualbrain robot init`, or set `check_description` to "kinematics"'
            if mode == "exact" and digest == ""
            else ""
        )
        self.warning = self._unknown_source
        self._text: str | None = None
        self.summary = "not checked" if mode == "none" else "not received"
        self.problem = (
            ""
            if mode == "none"
            else "No robot description was received. Remedy: start robot_state_publisher, or set "
            '`check_description` to "none"'
        )

    def receive(self, text: str) -> None:
        """Check the URDF `text`; sets `problem`, `warning`, `summary` and `base_frame`.

        The same text is not checked again: a check takes tens of milliseconds.
        """
        if self._mode == "none" or text == self._text:
            return
        self._text = text
        self.warning = self._unknown_source
        data = text.encode(errors="replace")
        digest = hashlib.sha256(data).hexdigest()
        exact = digest == self._digest
        self.summary = f"SHA-256 {digest[:12]}"
        if self._mode == "exact" and self._digest and not exact:
            self.problem = (
                f"The robot description has the SHA-256 {digest[:12]}…, but {self._model.name} was imported from "
                f"{self._digest[:12]}…. Remedy: import the description with `dualbrain robot init`, or set "
                '`check_description` to "kinematics"'
            )
            return
        try:
            joints = read_joints(data)
            self.problem = self._compare(joints)
        except ConfigurationError as error:
            self.problem = f"The robot description cannot be read: {error} Remedy: publish the URDF of the robot"
            return
        self.summary += ", the imported file" if exact else ""
        if not self.problem:
            self.summary += ", kinematics agree"
            self.warning = " ".join(filter(None, (self._narrower_limit(joints), self._unknown_source)))

    def _compare(self, joints: dict[str, UrdfJoint]) -> str:
        """Why `joints` are not those of the robot model, or ""; finds the base frame."""
        if missing := [name for name in self._names if name not in joints]:
            return f"The robot description has no joint {missing[0]}. Remedy: name the joints in the parameter `joints`"
        for name, joint in zip(self._names, self._model.joints, strict=True):
            if joints[name].kind not in KINDS[joint.kind]:
                return (
                    f"{name} is {joints[name].kind[:20] or 'of no type'} in the robot description, {joint.kind} in the "
                    "robot model. Remedy: import this description with `dualbrain robot init`"
                )
        postures = _postures(self._model)
        expected = [model_axes(self._model, q) for q in postures]
        found = [_axes_from_root(joints, self._names, dict(zip(self._names, q, strict=True))) for q in postures]
        bases = _fixed_frames(joints, self._names)
        mismatches = {name: self._mismatch(expected, found, base) for name, base in bases.items()}
        matching = [name for name, mismatch in mismatches.items() if mismatch is None]
        if matching and (not self._base or self._base in matching):
            self.base_frame = self._base or matching[-1]
            return ""
        if matching:
            return (
                f"The frame of the robot model is that of {matching[-1]}, not of {self._base[:60]}: all obstacles "
                f"would be displaced. Remedy: set `base_frame` to {matching[-1]}"
            )
        first = max((mismatch for mismatch in mismatches.values() if mismatch is not None), key=lambda one: one[0])
        return (
            f"The robot description is not {self._model.name}: the axis of {self._names[first[0]]} is {first[1]}. "
            "Remedy: import this description with `dualbrain robot init`, and pass its folder with `--robot`"
        )

    def _mismatch(self, expected: list[Array], found: list[Array], base: Array) -> tuple[int, str] | None:
        """The first joint whose axis differs, with the difference; None if all axes agree in the frame `base`."""
        for joint in range(self._model.n):
            for model, other in zip(expected, found, strict=True):
                direction = base[:3, :3].T @ other[joint, :3]
                point = base[:3, :3].T @ (other[joint, 3:] - base[:3, 3])
                angle = float(np.linalg.norm(direction - model[joint, :3]))
                offset = point - model[joint, 3:]
                beside = float(np.linalg.norm(offset - model[joint, :3] * (offset @ model[joint, :3])))
                if angle > DIRECTION_TOLERANCE:
                    return joint, f"turned by {angle:.3f} rad from that of the model"
                if beside > DISTANCE_TOLERANCE and self._model.joints[joint].kind == "revolute":
                    return joint, f"{beside:.4f} m beside that of the model"
        return None

    def _narrower_limit(self, joints: dict[str, UrdfJoint]) -> str:
        """The first limit of the description below that of the model, as a sentence with a remedy, or ""."""
        for name, joint in zip(self._names, self._model.joints, strict=True):
            limits = joints[name].limits
            stated = limits.get("velocity", inf)
            if 0.0 < stated < (1.0 - LIMIT_ROUNDING) * joint.velocity.value:
                return (
                    f"The description limits {name} to {stated:g} rad/s, the robot model to {joint.velocity.value:g}: "
                    "a controller that clips there voids the guarantee. Remedy: state the limit in a site file"
                )
            if joints[name].kind == "continuous":
                continue
            for side, sign in (("lower", -1.0), ("upper", 1.0)):
                bound: float = getattr(joint, side).value
                if sign * limits.get(side, bound) < sign * bound - LIMIT_ROUNDING:
                    return (
                        f"The description limits {name} at {limits[side]:g} rad, the robot model at {bound:g}. Remedy: "
                        "state the limit in a site file"
                    )
        return ""


# --- the URDF -----------------------------------------------------------------------------------------------------


def read_joints(data: bytes) -> dict[str, UrdfJoint]:
    """The joints of the URDF `data` by name; raises `ConfigurationError` for another content."""
    if len(data) > MAX_DESCRIPTION_BYTES:
        raise ConfigurationError(
            "size of the description", got=len(data), allowed=f"at most {MAX_DESCRIPTION_BYTES} bytes"
        )
    root = parse_xml(data, "robot_description")
    if root.tag != "robot":
        raise ConfigurationError("root element of the description", got=f"<{root.tag}>", allowed="<robot>")
    found: dict[str, UrdfJoint] = {}
    for element in root.iterchildren("joint"):
        name = element.get("name") or ""
        if name in found:
            raise ConfigurationError("joints of the description", got=f"{name} twice", allowed="each name once")
        found[name] = _read_joint(element, name)
    return found


def _read_joint(element: object, name: str) -> UrdfJoint:
    get = getattr(element, "find")  # noqa: B009  (lxml has no types)
    origin, limit = get("origin"), get("limit")
    roll, pitch, yaw = _numbers(origin, "rpy", (0.0, 0.0, 0.0), name)
    axis = np.array(_numbers(get("axis"), "xyz", (1.0, 0.0, 0.0), name))
    if not np.linalg.norm(axis) > 0.0:
        raise ConfigurationError(f"axis of joint {name}", got=axis.tolist(), allowed="a vector that is not zero")
    links = [get(tag).get("link") or "" if get(tag) is not None else "" for tag in ("parent", "child")]
    limits = {
        key: _numbers(limit, key, (0.0,), name)[0]
        for key in ("lower", "upper", "velocity")
        if limit is not None and limit.get(key) is not None
    }
    return UrdfJoint(
        name=name,
        kind=getattr(element, "get")("type") or "",  # noqa: B009
        parent=links[0],
        child=links[1],
        rotation=_rotation(roll, pitch, yaw),
        translation=np.array(_numbers(origin, "xyz", (0.0, 0.0, 0.0), name)),
        axis=axis / np.linalg.norm(axis),
        limits=limits,
    )


def _numbers(element: object, key: str, default: tuple[float, ...], joint: str) -> tuple[float, ...]:
    """The numbers of the attribute `key`; `default` without it."""
    text: str | None = None if element is None else getattr(element, "get")(key)  # noqa: B009
    if text is None:
        return default
    try:
        values = tuple(float(part) for part in text.split())
    except ValueError:
        values = ()
    if len(values) != len(default) or not np.isfinite(values).all():
        raise ConfigurationError(f"{key} of joint {joint}", got=text[:80], allowed=f"{len(default)} finite numbers")
    return values


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """R = Rz(yaw) Ry(pitch) Rx(roll)."""
    return _turn((0, 0, 1), yaw) @ _turn((0, 1, 0), pitch) @ _turn((1, 0, 0), roll)


def _turn(axis: tuple[float, float, float] | Array, angle: float) -> Array:
    """The rotation by `angle` [rad] about the unit vector `axis`."""
    half, (x, y, z) = 0.5 * angle, axis
    return quaternion_to_matrix((np.cos(half), *(np.sin(half) * part for part in (float(x), float(y), float(z)))))


# --- joint axes ---------------------------------------------------------------------------------------------------


def _postures(robot_model: RobotModel) -> list[Array]:
    """The zero posture and random ones within the joint limits, the same in every run."""
    rng = np.random.default_rng(0)
    lower = np.array([joint.lower.value for joint in robot_model.joints])
    upper = np.array([joint.upper.value for joint in robot_model.joints])
    return [np.zeros(robot_model.n), *(rng.uniform(lower, upper) for _ in range(POSTURES))]


def model_axes(robot_model: RobotModel, q: Array) -> Array:
    """Direction and a point (n, 6) of every joint axis of the robot model at q (n,), in its base frame."""
    frame, found = np.eye(4), np.zeros((robot_model.n, 6))
    for index, (joint, value) in enumerate(zip(robot_model.joints, q.tolist(), strict=True)):
        frame = frame @ _transform(quaternion_to_matrix(joint.quaternion), np.array(joint.translation))
        found[index] = [*frame[:3, 2], *frame[:3, 3]]
        frame = frame @ _motion(joint.kind, np.array([0.0, 0.0, 1.0]), value)
    return found


def _axes_from_root(joints: dict[str, UrdfJoint], names: tuple[str, ...], positions: dict[str, float]) -> Array:
    """Direction and a point (n, 6) of the axes of the joints `names` at `positions`, in the frame of the root link."""
    by_child = {joint.child: joint for joint in joints.values()}
    found = np.zeros((len(names), 6))
    for index, name in enumerate(names):
        joint = joints[name]
        frame = _link_frame(joint.parent, by_child, positions) @ _transform(joint.rotation, joint.translation)
        found[index] = [*(frame[:3, :3] @ joint.axis), *frame[:3, 3]]
    return found


def _link_frame(link: str, by_child: dict[str, UrdfJoint], positions: dict[str, float]) -> Array:
    """The pose of `link` in the root link; joints without a position are at 0."""
    frame, seen = np.eye(4), set[str]()
    while link in by_child:
        if link in seen:
            raise ConfigurationError("joints of the description", got=f"a loop at {link[:60]}", allowed="a tree")
        seen.add(link)
        joint = by_child[link]
        value = positions.get(joint.name, 0.0)
        frame = _transform(joint.rotation, joint.translation) @ _motion(joint.kind, joint.axis, value) @ frame
        link = joint.parent
    return frame


def _fixed_frames(joints: dict[str, UrdfJoint], names: tuple[str, ...]) -> dict[str, Array]:
    """Poses (4, 4) in the root link of all links that no joint of `names` moves, the root first."""
    by_child = {joint.child: joint for joint in joints.values()}
    links = dict.fromkeys(link for joint in joints.values() for link in (joint.parent, joint.child))
    found: dict[str, Array] = {}
    for link in links:
        above, seen = link, set[str]()
        while above in by_child and by_child[above].name not in names and above not in seen:
            seen.add(above)
            above = by_child[above].parent
        if above not in by_child:
            found[link] = _link_frame(link, by_child, {})
    return found


def _motion(kind: str, axis: Array, value: float) -> Array:
    """The motion of a joint by `value`."""
    if kind == "prismatic":
        return _transform(np.eye(3), axis * value)
    return _transform(_turn(axis, value), np.zeros(3)) if kind in ("revolute", "continuous") else np.eye(4)


def _transform(rotation: Array, translation: Array) -> Array:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, translation
    return frame
