"""Configuration of a gatekeeper process."""

from __future__ import annotations

import msgspec

from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.simulation.plant.plant_state import PlantState
from dualbrain.simulation.scenes.scene_spec import SceneSpec


class GatekeeperConfig(
    msgspec.Struct, frozen=True, kw_only=True, rename={"speed_scale": "stage", "tick_timing": "punctuality"}
):
    """Configuration of a gatekeeper: robot, scene, socket, keys, and files to write ("" for none).

    `capability` narrows the planner's authority; `speed_scale` is the initial one, (0, 1]. `report` and `tick_timing`
    are files that the robot process and the gatekeeper write at their end. `site` is a site file. With a `driver`, the
    gatekeeper moves a real arm at `address` (or its fake) instead of the simulated one; hardware requires the
    commissioning record `commissioned`. `realtime` is "enforce" or "ignore" (`FrankaDriver`). The gatekeeper registers
    itself in the folder `registrations` while it runs, as started by `started_by`. With `unrecorded` the arm may move
    on if the recording cannot be written. `start` is the state of the simulated robot at the beginning, by default at
    home, and `held` the object in its hand then. With `control_thread` a thread in C moves the joints
    (`ThreadedRobot`); None: with a driver.
    """

    robot: str
    scene: SceneSpec
    socket: str
    keys: str
    seed: int = 0
    goal: str = ""
    speed_scale: float = 1.0
    capability: Capability | None = None
    recording: str = ""
    instruction: str = ""
    report: str = ""
    tick_timing: str = ""
    site: str = ""
    driver: str = ""
    address: str = ""
    commissioned: str = ""
    realtime: str = "enforce"
    registrations: str = ""
    started_by: str = ""
    unrecorded: bool = False
    start: PlantState | None = None
    held: str = ""
    control_thread: bool | None = None
