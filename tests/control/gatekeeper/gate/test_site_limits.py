"""Limits of a site on objects reach the gate of a gatekeeper from its own site file, not from a commander."""

import pytest

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.deployment import Deployment
from dualbrain.control.gatekeeper.gate.contract_checker import ContractChecker
from dualbrain.control.gatekeeper.gate.exchange import GateRequest, GateSetup
from dualbrain.control.gatekeeper.gatekeeper import GatekeeperSettings
from dualbrain.records import ObjectLimits
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from tests.control.gatekeeper.lockstep_cell import make_cell
from tests.stories.story_session import GRASP, PLACE, contract_text

MODEL = load_robot("panda")
REGISTRY = skill_registry(MODEL)
SITE = "[object.red_cube]\nforce = 8.0\n"


@pytest.fixture(scope="module")
def limits(tmp_path_factory):
    """The limits as a gatekeeper with this site file has them."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "lab.toml").write_text(SITE)
    config = GatekeeperConfig(
        robot="panda", scene=open_scene("bare:0"), socket="s", keys="k", site=str(folder / "lab.toml")
    )
    return Deployment.from_config(config).object_limits


def verdict_on(cell, contract):
    loop = cell.gatekeeper.loop
    checker = ContractChecker(GateSetup(robot_model=MODEL, capabilities={"planner": full_capability(REGISTRY)}))
    header = ContractHeader(
        sequence=1, issued=0.0, expires=600.0, principal="planner", scene_version=loop.scene.version
    )
    return checker.check(
        GateRequest(
            connection_number=1,
            sequence=1,
            contract=contract,
            stamp=header,
            now=loop.now,
            scene=loop.scene,
            state=loop.state,
            holding=None,
        )
    )


@pytest.mark.parametrize(("force", "accepted"), [(20.0, False), (8.0, True)])
def test_the_gate_rejects_a_contract_beyond_the_limits_of_the_site(tmp_path, limits, force, accepted):
    assert limits == {"red_cube": ObjectLimits(force=8.0, source="lab.toml:1")}
    cell = make_cell(tmp_path, settings=GatekeeperSettings(timing=SIMULATED, object_limits=limits))
    with_force = contract_text(("grasp", GRASP | {"force": force}), ("place", PLACE)).encode()
    verdict = verdict_on(cell, with_force)
    cell.server.close()
    assert isinstance(verdict, Accepted if accepted else Rejected)
    if isinstance(verdict, Rejected):
        assert verdict.pointer == "/action_sequence/0/params/force"
        assert "lab.toml:1" in verdict.hint


def test_the_limits_are_in_the_scene_that_clients_receive(tmp_path, limits):
    cell = make_cell(tmp_path, settings=GatekeeperSettings(timing=SIMULATED, object_limits=limits))
    cell.gatekeeper.loop.begin()
    found = cell.gatekeeper.loop.scene.find("red_cube").limits
    cell.server.close()
    assert found == ObjectLimits(force=8.0, source="lab.toml:1")
