"""dualbrain scenes, scene show and scene new: list the families, show one scene, arrange a new one."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dualbrain.cli.common.arguments import PortOrAny
from dualbrain.cli.common.console import StderrConsole, print_result, print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.errors import ConfigurationError, MissingDependencyError, UsageError

if TYPE_CHECKING:
    from dualbrain.simulation.scenes.scene_spec import SceneSpec

Flag = Annotated[bool, Parameter(negative="")]
COUNTED_SEEDS = 8
"""Number of seeds over which the number of objects of a family is given."""


def list_scenes(*, robot: str = "panda") -> int:
    """List the scene families of a robot with their numbers, their numbers of objects, and their content.

    Parameters
    ----------
    robot
        panda, fr3, ur5e, base or mobile_panda.
    """
    from dualbrain.simulation.scenes.generators.catalogue import describe_families, open_scene

    _require_scenes(robot)
    rows: list[tuple[str, ...]] = []
    for family in describe_families(robot):
        specs = [open_scene(f"{family.name}:{seed}", robot) for seed in range(COUNTED_SEEDS)]
        counts = sorted({len(one.objects) for one in specs})
        objects = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else str(counts[0])
        persons = "yes" if any(one.mover for one in specs) else ""
        rows.append((family.name, family.numbers, objects, persons, family.description))
    print_table(("family", "as a number", "objects", "person", "content"), rows, wrap_columns=("content",))
    print_result("One scene: `dualbrain scene show FAMILY:SEED`, with any SEED from 0 on, or a number.")
    return ExitCode.SUCCESS


def show_scene(scene: str = "0", /, *, robot: str = "panda", image: Path | None = None, no_image: Flag = False) -> int:
    """Print a scene as a table, and write an image of it.

    Parameters
    ----------
    scene
        A number, FAMILY:SEED or a scene file.
    robot
        panda, fr3, ur5e, base or mobile_panda.
    image
        PNG file of the image. Default: scene_SCENE.png in this folder.
    no_image
        Print the table only.
    """
    from dualbrain.cli.common.graphics import choose_graphics

    reason = choose_graphics(os.environ)  # before MuJoCo is imported
    from dualbrain.cli.scenes.scene_table import scene_lines
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    if image is not None and image.suffix.lower() != ".png":
        raise UsageError("--image", got=str(image), allowed="the name of a PNG file, such as scene.png")
    _require_scenes(robot)
    spec = open_scene(scene, robot)
    for line in scene_lines(spec):
        print_result(line)
    if no_image:
        return ExitCode.SUCCESS
    path = image or Path(f"scene_{Path(scene).stem.replace(':', '_')}.png")
    try:
        _write_image(spec, robot, path)
    except MissingDependencyError as error:
        StderrConsole().print(f"no image: {reason or error}", markup=False)
    else:
        StderrConsole().print(f"image: {path}", markup=False)
    return ExitCode.SUCCESS


def _require_scenes(robot: str) -> None:
    """Raise `UnknownNameError` for an unknown robot, and `ConfigurationError` for one that is not simulated."""
    from dualbrain.robots.loader import SIMULATED_ROBOTS, load_robot

    load_robot(robot)
    if robot not in SIMULATED_ROBOTS:
        sentence = f"The robot {robot} has no scenes: the tables and rooms are those of {', '.join(SIMULATED_ROBOTS)}."
        raise ConfigurationError.stating(sentence, fix="Name one of these with --robot.")


def _write_image(spec: SceneSpec, robot: str, path: Path) -> None:
    from matplotlib.image import imsave

    from dualbrain.robots.loader import load_robot
    from dualbrain.simulation.perception.rendering import Camera
    from dualbrain.simulation.plant.factory import make_plant

    with Camera(make_plant(spec, load_robot(robot), visuals=True), shadows=True) as camera:
        imsave(path, camera.capture())


def new_scene(file: Path, /, *, scene: str = "bare:0", robot: str = "panda", port: PortOrAny = 8090) -> int:
    """Open a page in which objects are dragged, and save the scene as a file for `--scene FILE`.

    The page cannot be reached from other machines. It saves only a scene without problems: no overlaps, nothing beside
    the table, unique names. The command ends with Ctrl-C. Exit code 0 if a scene was saved, 1 if not.

    Parameters
    ----------
    file
        The scene file to write (.json); an existing one is opened for editing.
    scene
        The scene to begin with: a number, FAMILY:SEED or a scene file.
    robot
        panda, fr3 or ur5e: an arm at a table.
    port
        Port of the page, on the loopback interface.
    """
    from dualbrain.simulation.scenes.generators.catalogue import open_scene
    from dualbrain.visualization.scene_editor.server import SceneEditorServer

    if file.suffix != ".json":
        raise UsageError.stating(f"{file} is no name of a scene file.", fix=f"Call it {file.stem or 'mine'}.json.")
    _require_scenes(robot)
    original = open_scene(str(file) if file.exists() else scene, robot)
    if original.region:
        fix = "Name an arm with --robot, such as panda."
        raise ConfigurationError.stating("The editor arranges tables, and this scene is a room.", fix=fix)
    console, saves = StderrConsole(), list[float]()

    def on_save() -> None:
        saves.append(time.monotonic())
        console.print(f"saved: {file}", markup=False)
        console.print(f'Use it: dualbrain run "put the red cube in the bowl" --scene {file}', markup=False)

    try:
        server = SceneEditorServer(original, file, port, on_save)
    except OSError as error:
        raise ConfigurationError.stating(
            f"Port {port} cannot be used: {error.strerror}.", fix="Choose another one with --port, or 0 for any."
        ) from error
    console.print(f"scene editor: {server.url}  (Ctrl-C ends it)", markup=False)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        console.print("The editor is closed.")
    finally:
        server.server_close()
    return ExitCode.SUCCESS if saves else ExitCode.FAILED_SAFELY
