"""Loader of robot models: packaged robots, those of other packages, folders and files, whose entries are checked.

Another package provides a robot by an entry point in its pyproject.toml:

    [project.entry-points."dualbrain.robots"]
    my_arm = "my_package.robots:load_my_arm"     # a function without parameters, a RobotModel, or a path
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from importlib import resources
from importlib.metadata import EntryPoint, entry_points
from importlib.resources.abc import Traversable
from math import isfinite
from pathlib import Path

import msgspec

from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, UnknownNameError
from dualbrain.robots.model import Joint, Quaternion, RobotModel, Vector

SIMULATED_ROBOTS = ("panda", "fr3", "ur5e", "ur5e_lean", "base", "mobile_panda")
"""Packaged robots with a MuJoCo model, scenes and tasks."""
BUILTIN_ROBOTS = (*SIMULATED_ROBOTS, "so101", "vx300s")
"""All packaged robots."""

ENTRY_POINTS = "dualbrain.robots"
"""Group of the entry points of robots of other packages."""

ModelFault = tuple[str, object, str]
"""A wrong entry of a robot model: (entry, value, allowed values)."""
MODEL_FILE = "body.json"
MAX_FILE_BYTES = 4 * 2**20
LINK_GROUPS = ("base", "arm", "hand", "fingers")
"""Groups of links, by which contact permits and planes name them."""
MAX_TRANSLATION = 100.0
"""Largest translation in a robot model [m]: the filter computes in single precision, which resolves 8 µm there."""


def load_robot(name: str) -> RobotModel:
    """The packaged robot called `name`, that of another package, or the one at the path `name` ("./my_robot").

    A robot of another package never replaces a packaged one.

    Raises:
        UnknownNameError: There is neither a robot nor a path of this name.
        ConfigurationError: The file, folder or package does not contain a valid robot model.
    """
    if name in BUILTIN_ROBOTS:
        return _load_builtin(name)
    installed = installed_robots()
    if name in installed:
        return _checked_robot(name, _open_installed_robot(installed[name]))
    path = Path(name)
    if path.exists() or path.suffix == ".json" or len(path.parts) > 1:
        return read_robot(path)
    raise UnknownNameError("robot", name, (*BUILTIN_ROBOTS, *installed))


def _checked_robot(name: str, robot: RobotModel | Path) -> RobotModel:
    """The robot of another package, whose entries are checked as those of a file are."""
    if isinstance(robot, Path):
        return read_robot(robot)
    for entry, got, allowed in (*find_model_faults(robot), *find_home_faults(robot)):
        raise ConfigurationError(f"{entry} of the installed robot {name}", got=got, allowed=allowed)
    return robot


def installed_robots() -> dict[str, EntryPoint]:
    """The entry points of robots of other packages, by name; the first one of a name."""
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=ENTRY_POINTS):
        found.setdefault(entry.name, entry)
    return found


def _open_installed_robot(entry: EntryPoint) -> RobotModel | Path:
    """The robot model that `entry` names, or the path of its folder or file.

    Raises:
        ConfigurationError: The package fails when it is imported or called, or names something else.
    """
    package = entry.dist.name if entry.dist is not None else "unknown"
    try:
        loaded = entry.load()
        robot = loaded() if callable(loaded) else loaded
    except Exception as error:  # any error of the other package
        raise ConfigurationError.stating(
            f"The robot {entry.name!r} of the package {package} cannot be loaded: {type(error).__name__}: {error}.",
            fix=f"Report it to the authors of {package}, or use another version.",
        ) from error
    if isinstance(robot, RobotModel):
        return robot
    if isinstance(robot, (str, Path)):
        return Path(robot)
    raise ConfigurationError(
        f"robot {entry.name!r} of the package {package}",
        got=type(robot).__name__,
        allowed="a RobotModel, the path of a robot model, or a function without parameters that returns one of them",
    )


def load_builtin_robot(name: str) -> RobotModel:
    """The packaged robot called `name`; never a path, for names in files. Raises `UnknownNameError`."""
    if name not in BUILTIN_ROBOTS:
        raise UnknownNameError("packaged robot", name[:80], BUILTIN_ROBOTS)
    return _load_builtin(name)


@lru_cache
def _load_builtin(name: str) -> RobotModel:
    return msgspec.json.decode(data_file(name).read_bytes(), type=RobotModel)


def data_file(name: str) -> Traversable:
    """The data file of the packaged robot called `name`; it need not exist."""
    return resources.files("dualbrain.robots").joinpath("data", f"{name}.json")


def encode_robot(robot_model: RobotModel) -> bytes:
    """The content of the data file of `robot_model`: indented JSON with a final newline."""
    return msgspec.json.format(msgspec.json.encode(robot_model), indent=1) + b"\n"


def read_robot(path: Path) -> RobotModel:
    """The robot model in the JSON file `path`, or in the folder `path` that `dualbrain robot init` made.

    Raises:
        ConfigurationError: The file does not exist or is no valid robot model; the message names the wrong entry.
    """
    file = path / MODEL_FILE if path.is_dir() else path
    data = read_regular_file(file, MAX_FILE_BYTES)
    if isinstance(data, FileRefusal):
        problem = f"There is no robot model at {path}." if data.kind == "missing" else data.sentence
        raise ConfigurationError.stating(
            problem,
            fix=f"Give the name of a packaged robot ({', '.join(BUILTIN_ROBOTS)}), a folder with {MODEL_FILE}, or a "
            f"JSON file of at most {MAX_FILE_BYTES} bytes.",
        )
    try:
        robot_model = msgspec.json.decode(data, type=RobotModel)
    except DECODE_ERRORS as error:
        raise ConfigurationError.stating(f"{file.name} is not a robot model: {error}.", fix=f"Fix {file}.") from error
    for entry, got, allowed in (*find_model_faults(robot_model), *find_home_faults(robot_model)):
        raise ConfigurationError(f"{entry} in {file.name}", got=got, allowed=allowed, fix=f"Fix {file}.")
    return robot_model


def find_model_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    """The wrong entries of `robot_model`, also of one whose joint ranges a site has narrowed."""
    if not robot_model.joints:
        yield "joints", 0, "at least one"
    names = [joint.name for joint in robot_model.joints]
    if len(set(names)) != len(names):
        yield "joints", names, "each name once"
    for joint in robot_model.joints:
        yield from _joint_faults(joint)
    yield from _link_faults(robot_model)
    yield from _sphere_faults(robot_model)
    yield from _tracking_faults(robot_model)
    yield from _gripper_faults(robot_model)
    yield from _dynamics_faults(robot_model)
    yield from _force_sensing_faults(robot_model)
    if not 0.0 < robot_model.period <= 1.0:
        yield "period", robot_model.period, "above 0, at most 1 s"
    if not robot_model.tool_speed.value > 0.0:
        yield "tool_speed", robot_model.tool_speed.value, "above 0 m/s"
    yield from _frame_faults("the tool", robot_model.tool.translation, robot_model.tool.quaternion)
    if robot_model.gain is not None and not robot_model.gain.value > 0.0:
        yield "gain", robot_model.gain.value, "above 0"
    if len(robot_model.home) != robot_model.nq:
        yield (
            "home",
            list(robot_model.home),
            f"{robot_model.nq} values: x, y and heading of a mobile base, then one for each joint",
        )


def find_home_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    """The joints whose home position is outside of their range; the pose of a mobile base has no range."""
    pose, wheels = (3, 2) if robot_model.is_mobile else (0, 0)
    if not all(map(isfinite, robot_model.home)):
        yield "home", list(robot_model.home), "finite numbers"
    for joint, home in zip(robot_model.joints[wheels:], robot_model.home[pose:], strict=False):
        if not joint.lower.value <= home <= joint.upper.value:
            yield f"home of joint {joint.name!r}", home, f"{joint.lower.value:g} to {joint.upper.value:g}"


def _gripper_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    gripper = robot_model.gripper
    numbers = {
        "opening": gripper.opening.value,
        "force": gripper.force.value,
        "force_min": gripper.force_min.value,
        "finger_thickness": gripper.finger_thickness,
    }
    for name, value in numbers.items():
        if not (isfinite(value) and value >= 0.0):
            yield f"{name} of the gripper", value, "at least 0"
    if not isfinite(gripper.pad_below_tool):
        yield "pad_below_tool of the gripper", gripper.pad_below_tool, "a finite number"
    if not gripper.force_min.value <= gripper.force.value:
        yield "force_min of the gripper", gripper.force_min.value, f"at most its force, {gripper.force.value:g} N"


def _tracking_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    for tracking in (robot_model.tracking, *robot_model.other_drives):
        errors = tracking.position_errors(robot_model.n)
        if len(errors) != robot_model.n or not all(isfinite(error) and error >= 0.0 for error in errors):
            allowed = f"one number of at least 0, or {robot_model.n} for the joints"
            yield f"position_error of the drive {tracking.drive!r}", errors, allowed
        for name in ("lag", "rate"):
            value: float = getattr(tracking, name)
            if not (isfinite(value) and value >= 0.0):
                yield f"{name} of the drive {tracking.drive!r}", value, "at least 0"
    base_lag = robot_model.base_lag
    if base_lag is not None and not (isfinite(base_lag) and base_lag >= 0.0):
        yield "base_lag", base_lag, "at least 0 s"


def _dynamics_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    dynamics = robot_model.dynamics
    if dynamics is None:
        return
    for body in dynamics.bodies:
        if not 1 <= body.frame <= robot_model.n:
            yield "frame of a body of dynamics", body.frame, f"1 to {robot_model.n}"
        numbers = (body.mass, *body.centre, *body.inertia)
        if not (all(map(isfinite, numbers)) and body.mass >= 0.0 and min(body.inertia[:3]) >= 0.0):
            yield "body of dynamics", numbers, "finite numbers, a mass and moments of inertia of at least 0"
    for name in ("rotor_inertia", "damping"):
        values: tuple[float, ...] = getattr(dynamics, name)
        if len(values) != robot_model.n or not all(isfinite(value) and value >= 0.0 for value in values):
            yield f"{name} of dynamics", list(values), f"{robot_model.n} numbers of at least 0"
    if not (isfinite(dynamics.payload.value) and dynamics.payload.value >= 0.0):
        yield "payload of dynamics", dynamics.payload.value, "at least 0 kg"


def _force_sensing_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    sensing = robot_model.force_sensing
    if sensing is None:
        return
    if robot_model.dynamics is None:
        yield "dynamics", None, "the masses of the robot, because force_sensing is declared"
    channels = robot_model.n if sensing.kind == "motor_torques" else 6
    for name in ("noise", "accuracy"):
        values: tuple[float, ...] = getattr(sensing, name)
        if len(values) != channels or not all(isfinite(value) and value >= 0.0 for value in values):
            yield f"{name} of force_sensing", list(values), f"{channels} numbers of at least 0"


def _link_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    names = [link.name for link in robot_model.links]
    if len(set(names)) != len(names):
        yield "links", names, "each name once"
    for link in robot_model.links:
        if not 0 <= link.frame <= robot_model.n:
            yield f"frame of link {link.name!r}", link.frame, f"0 to {robot_model.n}"
        if link.group not in LINK_GROUPS:
            yield f"group of link {link.name!r}", link.group, ", ".join(LINK_GROUPS)
        if any(link.slide) and not _is_unit(link.slide):
            yield f"slide of link {link.name!r}", link.slide, "a vector of length 1, or zero"
        yield from _frame_faults(f"link {link.name!r}", link.translation, link.quaternion)
    paired = {name for pair in robot_model.self_pairs.kept for name in pair}
    for user, used in (("a self-collision pair", paired), ("the tool", {robot_model.tool.link})):
        for name in sorted(used - set(names)):
            yield f"link of {user}", name, ", ".join(names)


def _sphere_faults(robot_model: RobotModel) -> Iterator[ModelFault]:
    names = {link.name for link in robot_model.links}
    if not robot_model.spheres:
        yield "spheres", 0, "at least one: the filter keeps only spheres away from obstacles"
    for sphere in robot_model.spheres:
        if sphere.link not in names:
            yield "link of a sphere", sphere.link, ", ".join(sorted(names))
        if not (0.0 < sphere.radius < 10.0 and _is_near(sphere.centre)):
            got = (sphere.centre, sphere.radius)
            allowed = f"a centre within {MAX_TRANSLATION:g} m, a radius above 0 and below 10 m"
            yield f"sphere of {sphere.link!r}", got, allowed


def _joint_faults(joint: Joint) -> Iterator[ModelFault]:
    where = f"joint {joint.name!r}"
    if not (isfinite(joint.lower.value) and isfinite(joint.upper.value) and joint.lower.value < joint.upper.value):
        yield f"range of {where}", (joint.lower.value, joint.upper.value), "lower below upper"
    for limit in ("velocity", "acceleration"):
        value = getattr(joint, limit).value
        if not (isfinite(value) and value > 0.0):
            yield f"{limit} of {where}", value, "above 0"
    if joint.jerk is not None and not joint.jerk.value > 0.0:
        yield f"jerk of {where}", joint.jerk.value, "above 0"
    yield from _frame_faults(where, joint.translation, joint.quaternion)


def _frame_faults(where: str, translation: Vector, quaternion: Quaternion) -> Iterator[ModelFault]:
    if not _is_near(translation):
        yield f"translation of {where}", translation, f"finite numbers, at most {MAX_TRANSLATION:g} m"
    if not _is_unit(quaternion):
        yield f"quaternion of {where}", quaternion, "of length 1 (w, x, y, z)"


def _is_near(translation: Vector) -> bool:
    return all(abs(value) <= MAX_TRANSLATION for value in translation)


def _is_unit(values: Iterable[float]) -> bool:
    return abs(sum(value * value for value in values) - 1.0) < 1e-6
