"""Hardware is opened only with a commissioning record of acceptable answers for this robot at this site."""

from pathlib import Path

import msgspec
import pytest

from dualbrain.cli.main import run_command_line
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.deployment import Deployment
from dualbrain.drivers.catalogue import find_driver_kind
from dualbrain.drivers.commissioning.checklist import TEMPLATE, find_flaws, find_limit_flaws, read_checklist
from dualbrain.drivers.commissioning.record import NotCommissionedError, require_record
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.safety.integration.site import site_robot
from dualbrain.simulation.scenes.generators.catalogue import open_scene

KIND = find_driver_kind("franka", "fr3")
SITE = (
    """
[limits]
acceleration = 9.0
jerk = 4500.0
[joint]
"""
    + "".join(
        f"fr3_joint{k} = {{ velocity = {v} }}\n" for k, v in enumerate((1.9, 0.95, 1.4, 1.2, 2.9, 1.4, 2.9), start=1)
    )
    + """
[[plane]]
name = "table"
point = [0, 0, 0]
inward = [0, 0, 1]
"""
)
GOOD = """
by = "A. Tester"
on = "2026-11-21"
[tool]
name = "Franka hand"
mass = 0.73
set_at_controller = true
[payload]
mass = 0.5
[mounting]
on = "floor"
lean = 0.003
bolted = true
[table]
points = [[0.4, 0.3, -0.001], [0.4, -0.3, 0.0], [0.7, 0.0, -0.002]]
[estop]
speed = 0.3
rest = 0.2
latched = true
reset_in_two_steps = true
"""


@pytest.fixture
def lab(tmp_path):
    (tmp_path / "lab.toml").write_text(SITE)
    (tmp_path / "answers.toml").write_text(GOOD)
    return tmp_path


def flawed_entries(folder):
    file = read_site(folder / "lab.toml")
    robot_model = site_robot(load_robot("fr3"), file)
    return [flaw.item for flaw in find_flaws(read_checklist(folder / "answers.toml"), robot_model, file.site, KIND)]


def commission(folder, *options):
    site = str(folder / "lab.toml")
    return run_command_line(
        ["robot", "commission", str(folder / "answers.toml"), "--driver", "franka", "--site", site, *options]
    )


def gatekeeper_config(folder, driver="franka"):
    record = folder / "answers.sealed.json"
    return GatekeeperConfig(
        robot="fr3",
        scene=open_scene("bare:0", "fr3"),
        socket="s",
        keys="k",
        site=str(folder / "lab.toml"),
        driver=driver,
        address="10.0.0.2",
        commissioned=str(record) if record.exists() else "",
    )


def test_acceptable_answers_are_recorded_and_open_the_arm(lab, capsys):
    assert commission(lab) == 0
    assert commission(lab, "--check") == 0
    assert "A. Tester" in capsys.readouterr().err
    deployment = Deployment.from_config(gatekeeper_config(lab))
    assert deployment.driver is KIND
    assert deployment.filter_config.jerk_limits
    assert [obstacle.name for obstacle in deployment.fixed_obstacles] == ["table"]


@pytest.mark.parametrize(
    ("old", "new", "item"),
    [
        ('by = "A. Tester"', 'by = " "', "by"),
        ("mass = 0.73", "mass = nan", "tool"),
        ("set_at_controller = true", "set_at_controller = false", "tool.set_at_controller"),
        ("mass = 0.73", "mass = 0.73\ntip = [0.0, 0.0, 0.1]", "tool.tip [m]"),
        ("mass = 0.5", "mass = 2.5", "payload.mass [kg]"),
        ("lean = 0.003", "lean = nan", "mounting.lean [rad]"),
        ('on = "floor"', 'on = "wall"', "mounting.on"),
        ("bolted = true", "bolted = false", "mounting.bolted"),
        ("[0.7, 0.0, -0.002]", "[0.7, 0.0, 0.004]", "table.points"),
        ("[0.7, 0.0, -0.002]", "[0.4, 0.0, 0.0]", "table.points"),
        ("[0.7, 0.0, -0.002]", "[0.7, nan, -0.002]", "table.points"),
        ("[0.4, 0.3, -0.001]", "[inf, 0.3, -0.001]", "table.points"),
        ("[[0.4, 0.3, -0.001], [0.4, -0.3, 0.0], [0.7, 0.0, -0.002]]", "[]", "table.points"),
        ("rest = 0.2", "rest = 0.8", "estop.rest [s]"),
        ("speed = 0.3", "speed = 0.0", "estop.speed [rad/s]"),
        ("latched = true", "latched = false", "estop.latched"),
        ("reset_in_two_steps = true", "reset_in_two_steps = false", "estop.reset_in_two_steps"),
    ],
)
def test_an_unacceptable_answer_is_named_and_nothing_is_recorded(lab, capsys, old, new, item):
    assert old in GOOD
    (lab / "answers.toml").write_text(GOOD.replace(old, new))
    assert flawed_entries(lab)[0] == item
    assert commission(lab) == 1
    assert item in capsys.readouterr().err
    assert not (lab / "answers.sealed.json").exists()


def test_limits_must_be_strictly_inside_those_of_the_manufacturer(lab):
    """The packaged model has the manufacturer's limits: without a site that narrows them, every joint is a flaw."""
    robot_model = load_robot("fr3")
    limits = {flaw.item.split(" of ")[0] for flaw in find_limit_flaws(robot_model, KIND)}
    assert limits == {"velocity", "acceleration", "jerk"}
    assert len(find_limit_flaws(robot_model, KIND)) == 3 * robot_model.n
    assert find_limit_flaws(site_robot(robot_model, read_site(lab / "lab.toml")), KIND) == ()
    ur = find_driver_kind("ur", "ur5e")
    assert {flaw.item.split(" of ")[0] for flaw in find_limit_flaws(load_robot("ur5e"), ur)} == {"range", "velocity"}


def test_the_template_is_a_checklist_whose_entries_are_all_to_be_filled_in(lab):
    (lab / "answers.toml").unlink()
    assert commission(lab) == 1
    assert (lab / "answers.toml").read_text() == TEMPLATE.format(robot="fr3", driver="franka")
    assert len(flawed_entries(lab)) >= 10
    assert commission(lab) == 1


def test_without_a_record_the_gatekeeper_names_the_command_that_makes_one(lab, capsys):
    with pytest.raises(NotCommissionedError, match="dualbrain robot commission"):
        Deployment.from_config(gatekeeper_config(lab))
    assert (
        run_command_line(
            [
                "gatekeeper",
                "--robot",
                "fr3",
                "--scene",
                "bare:0",
                "--driver",
                "franka",
                "--address",
                "10.0.0.2",
                "--socket",
                str(lab / "s"),
                "--keys",
                str(lab / "k"),
            ]
        )
        == 5
    )
    assert not (lab / "s").exists()
    assert "Ctrl-C" not in capsys.readouterr().err, "the gatekeeper must not start"


def test_the_plant_and_the_fakes_need_no_record(lab):
    assert Deployment.from_config(gatekeeper_config(lab, "fake_franka")).driver.name == "fake_franka"
    assert Deployment.from_config(msgspec.structs.replace(gatekeeper_config(lab), driver="")).driver is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lab: (lab / "lab.toml").write_text(SITE + "# moved the table\n"), "site file of the commissioning"),
        (lambda lab: (lab / "lab.toml").write_text(SITE.replace("9.0", "9.5")), "robot model|site file"),
        (lambda lab: _edit(lab, b"0.73", b"0.10"), "checksum"),
        (lambda lab: _edit(lab, b'"driver": "franka"', b'"driver": "ur"'), "checksum"),
        (lambda lab: (lab / "answers.sealed.json").write_bytes(b"{}"), "commissioning record"),
    ],
    ids=["site file", "limits", "answer", "driver", "invalid"],
)
def test_a_change_after_the_commissioning_is_refused(lab, change, message):
    assert commission(lab) == 0
    change(lab)
    with pytest.raises(NotCommissionedError, match=message):
        Deployment.from_config(gatekeeper_config(lab))
    assert commission(lab, "--check") == 5


def _edit(lab: Path, old: bytes, new: bytes) -> None:
    record = lab / "answers.sealed.json"
    assert old in record.read_bytes()
    record.write_bytes(record.read_bytes().replace(old, new))


def test_another_robot_model_is_refused(lab):
    assert commission(lab) == 0
    robot_model = site_robot(load_robot("fr3"), read_site(lab / "lab.toml"))
    other = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[1:])
    with pytest.raises(NotCommissionedError, match="robot model of the commissioning record"):
        require_record(lab / "answers.sealed.json", other, lab / "lab.toml", KIND)


def test_a_scene_with_a_moving_object_is_refused_for_a_driver(lab):
    scene = open_scene("forearm:0", "fr3")
    with pytest.raises(ConfigurationError, match="moves"):
        Deployment.from_config(msgspec.structs.replace(gatekeeper_config(lab, "fake_franka"), scene=scene))
