"""Configuration of a gatekeeper process."""

from __future__ import annotations

import msgspec

from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.simulation.scenes.scene_spec import SceneSpec


class GatekeeperConfig(msgspec.Struct, frozen=True, kw_only=True):
    """What a gatekeeper is to be: which robot in which scene, where it listens, what it writes ("" for nothing).

    `capability` narrows what the planner may ask for; `stage` is the speed to begin with. `report` and `punctuality`
    are files that the robot and the gatekeeper leave at their end. `site` is a site file. With a `driver` a real arm at
    `address` is moved (or its fake) instead of the simulated one; hardware demands the record in `commissioned`.
    """

    robot: str
    scene: SceneSpec
    socket: str
    keys: str
    seed: int = 0
    goal: str = ""
    stage: float = 1.0
    capability: Capability | None = None
    recording: str = ""
    instruction: str = ""
    report: str = ""
    punctuality: str = ""
    site: str = ""
    driver: str = ""
    address: str = ""
    commissioned: str = ""
