"""The gatekeeper of an agent's robot: started for a simulated robot, or running already."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import read_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import Message
from dualbrain.control.gatekeeper.protocol.registration import REGISTRATIONS
from dualbrain.control.gatekeeper.protocol.socket_folder import KEYS_NAME, SOCKET_NAME, socket_folder
from dualbrain.core.paths import dualbrain_home
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import read_site
from dualbrain.safety.integration.site import site_robot
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOptions:
    """A simulated robot in real time: its `scene` (number, FAMILY:SEED or file), and the `seed` of its perception.

    `speed` is the initial speed scale, (0, 1]. With `recording`, every tick is written to this MCAP file; with
    `report`, the robot's ground truth is written to this file at its end.
    """

    robot: str = "panda"
    scene: str = "0"
    seed: int = 0
    speed: float = 1.0
    site: Path | None = None
    recording: Path | None = None
    report: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Connection:
    """A connected commander: the `client`, the robot's model, and the `socket` of its gatekeeper.

    `model_without_site` is the robot model without the limits of the site, for the postures of the memory. `process` is
    that of a gatekeeper that was started here, None for one that was running.
    """

    client: GatekeeperClient
    robot_model: RobotModel
    model_without_site: RobotModel
    socket: Path
    process: GatekeeperProcess | None = None


def start_simulation(
    options: SimulationOptions, on_report: Callable[[Message], None], started_by: str, stack: ExitStack
) -> Connection:
    """A new gatekeeper with a simulated robot; `stack` ends it, and it ends with this process.

    Raises `ConfigurationError`, `UnknownNameError`, and `SiteError` for an invalid site file.
    """
    folder = stack.enter_context(socket_folder())
    config = GatekeeperConfig(
        robot=options.robot,
        scene=open_scene(options.scene, options.robot),
        socket=str(folder / SOCKET_NAME),
        keys=str(folder / KEYS_NAME),
        seed=options.seed,
        speed_scale=options.speed,
        site=str(options.site or ""),
        recording=str(options.recording or ""),
        report=str(options.report or ""),
        registrations=str(dualbrain_home() / REGISTRATIONS),
        started_by=started_by,
    )
    process = GatekeeperProcess(config)
    stack.callback(process.stop)
    found = connect(Path(config.socket), Path(config.keys), options.robot, options.site, on_report, stack)
    return dataclasses.replace(found, process=process)


def connect(
    socket: Path, keys: Path, robot: str, site: Path | None, on_report: Callable[[Message], None], stack: ExitStack
) -> Connection:
    """A connection to the running gatekeeper at `socket` as its commander; `stack` closes it.

    `robot` is the name or folder of the robot, "" for the name that the gatekeeper reports. Raises `ConfigurationError`
    if no gatekeeper listens, or if its skills are not those of the robot at this site, `ConnectionLostError` if it has
    a commander already.
    """
    client = GatekeeperClient(socket, read_keys(keys, (PLANNER,)), PLANNER, on_report=on_report)
    stack.callback(client.close)
    loaded = load_robot(robot or client.welcome.robot)
    model = site_robot(loaded, read_site(site)) if site else loaded
    if skill_registry(model).hash != client.welcome.registry:
        raise ConfigurationError.stating(
            f"The gatekeeper at {socket} has other skills or bounds than {model.name}"
            f"{' at this site' if site else ''}.",
            fix="Name the robot and the site file with which the gatekeeper was started.",
        )
    return Connection(client=client, robot_model=model, model_without_site=loaded, socket=socket)
