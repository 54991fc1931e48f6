"""State at the end of a simulated run, from which another run can continue: objects, persons, posture and grip.

The time of the next run begins at 0 again: the cycle of a moving person continues from where it was.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.plant_state import PlantState
from dualbrain.simulation.scenes.scene_spec import MAX_FILE_BYTES, SceneSpec, check_scene


class EndState(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The `scene` with all objects at their true poses at rest, the state of the robot, and the object in its hand."""

    scene: SceneSpec
    robot: PlantState
    held: str = ""


def read_end_state(plant: Plant, held: str = "") -> EndState:
    """The state of `plant` now; `held` is the name of the object that the robot holds, "" for none."""
    spec = plant.spec
    poses = {obj.name: plant.true_pose(obj.name) for obj in spec.objects}
    objects = tuple(
        msgspec.structs.replace(obj, position=poses[obj.name].position, quaternion=poses[obj.name].quaternion)
        for obj in spec.objects
    )
    mover = spec.mover
    if mover is not None:
        mover = msgspec.structs.replace(mover, phase=mover.phase + plant.now)
    scene = msgspec.structs.replace(spec, objects=objects, mover=mover)
    return EndState(scene=scene, robot=plant.state(), held=held)


def save_end_state(state: EndState, path: Path) -> None:
    """Write `state` as JSON. Raises `FileWriteError`."""
    write_atomically(path, msgspec.json.encode(state) + b"\n")


def load_end_state(path: Path) -> EndState:
    """Read the file of `save_end_state`; raises `ConfigurationError`."""
    content = read_regular_file(path, MAX_FILE_BYTES)
    fix = "Name the folder of a simulated run that ended by itself."
    if isinstance(content, FileRefusal):
        raise ConfigurationError.stating(f"The end of the earlier run cannot be read: {content.sentence}", fix=fix)
    try:
        state = msgspec.json.decode(content, type=EndState)
    except DECODE_ERRORS as error:
        sentence = f"The file {path} does not contain the end of a run: {error}."
        raise ConfigurationError.stating(sentence, fix=fix) from error
    check_scene(state.scene)
    return state
