"""Hardware is opened only with a sealed record of answers that will do, for this body at this site."""

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


def told(folder, **changes):
    text = (folder / "answers.toml").read_text()
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    (folder / "answers.toml").write_text(text)
    file = read_site(folder / "lab.toml")
    robot_model = site_robot(load_robot("fr3"), file)
    return [flaw.item for flaw in find_flaws(read_checklist(folder / "answers.toml"), robot_model, file.site, KIND)]


def command(folder, *more):
    site = str(folder / "lab.toml")
    return run_command_line(
        ["robot", "commission", str(folder / "answers.toml"), "--driver", "franka", "--site", site, *more]
    )


def plan(folder, driver="franka"):
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


def test_answers_that_will_do_are_sealed_and_open_the_arm(lab, capsys):
    assert command(lab) == 0
    assert command(lab, "--check") == 0
    assert "A. Tester" in capsys.readouterr().err
    place = Deployment.from_config(plan(lab))
    assert place.driver is KIND
    assert place.filter_config.jerk_limits
    assert [one.name for one in place.fixed_obstacles] == ["table"]


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
        ("[[0.4, 0.3, -0.001], [0.4, -0.3, 0.0], [0.7, 0.0, -0.002]]", "[]", "table.points"),
        ("rest = 0.2", "rest = 0.8", "estop.rest [s]"),
        ("speed = 0.3", "speed = 0.0", "estop.speed [rad/s]"),
        ("latched = true", "latched = false", "estop.latched"),
        ("reset_in_two_steps = true", "reset_in_two_steps = false", "estop.reset_in_two_steps"),
    ],
)
def test_an_answer_that_will_not_do_is_named_and_nothing_is_sealed(lab, capsys, old, new, item):
    assert told(lab, one=(old, new))[0] == item
    assert command(lab) == 1
    assert item in capsys.readouterr().err
    assert not (lab / "answers.sealed.json").exists()


def test_our_limits_lie_strictly_inside_the_makers(lab):
    """The shipped body has the maker's own numbers: without a site that narrows it, every joint is a flaw."""
    robot_model = load_robot("fr3")
    sides = {flaw.item.split(" of ")[0] for flaw in find_limit_flaws(robot_model, KIND)}
    assert sides == {"velocity", "acceleration", "jerk"}
    assert len(find_limit_flaws(robot_model, KIND)) == 3 * robot_model.n
    assert find_limit_flaws(site_robot(robot_model, read_site(lab / "lab.toml")), KIND) == ()
    ur = find_driver_kind("ur", "ur5e")
    assert {flaw.item.split(" of ")[0] for flaw in find_limit_flaws(load_robot("ur5e"), ur)} == {"range", "velocity"}


def test_the_template_is_the_checklist_with_everything_still_to_answer(lab):
    (lab / "answers.toml").unlink()
    assert command(lab) == 1
    assert (lab / "answers.toml").read_text() == TEMPLATE.format(robot="fr3", driver="franka")
    assert len(told(lab)) >= 10
    assert command(lab) == 1


def test_without_a_record_the_gatekeeper_says_what_to_do(lab, capsys):
    with pytest.raises(NotCommissionedError, match="dualbrain robot commission"):
        Deployment.from_config(plan(lab))
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
    assert "Ctrl-C" not in capsys.readouterr().err, "what was refused does not run"


def test_the_plant_and_the_fakes_need_none(lab):
    assert Deployment.from_config(plan(lab, "fake_franka")).driver.name == "fake_franka"
    assert Deployment.from_config(msgspec.structs.replace(plan(lab), driver="")).driver is None


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda lab: (lab / "lab.toml").write_text(SITE + "# moved the table\n"), "site"),
        (lambda lab: (lab / "lab.toml").write_text(SITE.replace("9.0", "9.5")), "body|site"),
        (lambda lab: _edit(lab, b"0.73", b"0.10"), "seal"),
        (lambda lab: _edit(lab, b'"driver": "franka"', b'"driver": "ur"'), "seal"),
        (lambda lab: (lab / "answers.sealed.json").write_bytes(b"{}"), "commissioning record"),
    ],
    ids=["site file", "limits", "answer", "driver", "rubbish"],
)
def test_whatever_changed_since_is_refused(lab, change, what):
    assert command(lab) == 0
    change(lab)
    with pytest.raises(NotCommissionedError, match=what):
        Deployment.from_config(plan(lab))
    assert command(lab, "--check") == 5


def _edit(lab: Path, old: bytes, new: bytes) -> None:
    record = lab / "answers.sealed.json"
    assert old in record.read_bytes()
    record.write_bytes(record.read_bytes().replace(old, new))


def test_another_body_is_refused(lab):
    assert command(lab) == 0
    robot_model = site_robot(load_robot("fr3"), read_site(lab / "lab.toml"))
    other = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[1:])
    with pytest.raises(NotCommissionedError, match="body"):
        require_record(lab / "answers.sealed.json", other, lab / "lab.toml", KIND)


def test_a_scene_in_which_something_moves_is_refused_for_a_driver(lab):
    scene = open_scene("forearm:0", "fr3")
    with pytest.raises(ConfigurationError, match="moves"):
        Deployment.from_config(msgspec.structs.replace(plan(lab, "fake_franka"), scene=scene))
