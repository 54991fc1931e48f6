"""Speed limits near a person: the contact speed of ISO/TS 15066, and the limit of the parts within a distance."""

import re
from math import sqrt

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import SiteError, read_site
from dualbrain.safety.cbf.filter import FilterConfig, FilterStatus, Obstacle, Rank, SafetyFilter
from dualbrain.safety.cbf.obstacles import NearSpeed, PersonLimits, SpeedAndSeparation, obstacles_from_scene
from dualbrain.safety.integration.power_and_force import (
    BODY_REGIONS,
    BodyRegion,
    body_region,
    contact_speed,
    effective_mass,
    reduced_mass,
    transfer_energy,
)
from dualbrain.safety.integration.site import site_persons
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle


def test_the_contact_speed_gives_the_largest_force_and_the_transfer_energy():
    """An impact of the reduced mass on the spring, integrated in time, reaches the largest force and no more."""
    region, robot = BODY_REGIONS["chest"], effective_mass(18.0, 1.0)
    assert robot == 10.0
    mass, speed = reduced_mass(region.mass, robot), contact_speed(region, robot)
    assert mass == pytest.approx(8.0)
    x, v, dt, force = 0.0, speed, 1e-6, 0.0
    while v > 0.0:
        v -= dt * region.stiffness * x / mass
        x += dt * v
        force = max(force, region.stiffness * x)
    assert force == pytest.approx(2.0 * region.force, rel=1e-3)
    assert 0.5 * mass * speed**2 == pytest.approx(transfer_energy(region))
    assert speed == pytest.approx(280.0 / sqrt(8.0 * 25e3))


def test_a_heavier_robot_and_a_smaller_pressure_are_slower():
    region = BODY_REGIONS["hand"]
    speeds = [contact_speed(region, mass) for mass in (1.0, 5.0, 20.0)]
    assert speeds == sorted(speeds, reverse=True)
    limited = contact_speed(region, 5.0, pressure=1e6, area=1e-4)
    assert limited == pytest.approx(contact_speed(region, 5.0) * 100.0 / 280.0)
    assert contact_speed(region, 5.0, pressure=1e9, area=1.0) == contact_speed(region, 5.0)


def test_what_the_formula_does_not_cover_is_refused():
    for name in ("skull", "face"):
        with pytest.raises(ConfigurationError, match="no transient contact"):
            contact_speed(BODY_REGIONS[name], 5.0)
    with pytest.raises(ConfigurationError, match="pressure"):
        contact_speed(BODY_REGIONS["chest"], 5.0, pressure=1e6)
    with pytest.raises(UnknownNameError):
        body_region("torso")
    for bad in ({"mass": 0.0}, {"stiffness": float("nan")}, {"force": -1.0}, {"transient": 0.5}):
        with pytest.raises(GeometryError):
            BodyRegion(**{"mass": 1.0, "stiffness": 1e4, "force": 100.0, "transient": 2.0, "source": "test"} | bad)
    for mass in (0.0, -1.0, float("inf")):
        with pytest.raises(GeometryError):
            effective_mass(mass)


# --- the limit of the parts near a person -------------------------------------------------------------------------

NEAR = NearSpeed(speed=0.1, distance=0.25, brake=1.0)


def person(x, *, velocity=0.0, near=NEAR):
    return Obstacle(
        name="person",
        shape=Capsule(0.1, 0.6),
        pose=Pose((x, 0.3, 0.5)),
        velocity=(velocity, 0.0, 0.0),
        static=False,
        rank=Rank.BODY,
        near=near,
    )


def part_distances(oracle, radii, q, x):
    """Distance of every point's sphere from the surface of the person."""
    points = oracle.points(q)
    axis = np.column_stack([np.full(len(points), x), np.full(len(points), 0.3), np.clip(points[:, 2], -0.1, 1.1)])
    return np.linalg.norm(points - axis, axis=1) - 0.1 - np.append(radii, 0.0)


def push(near, *, velocity=0.0, steps=1500, seed=1):
    """Largest speed within the distance and beyond it, and the number of reports, under a hostile nominal control."""
    model, rng = load_robot("panda"), np.random.default_rng(seed)
    safety, oracle = SafetyFilter(model, FilterConfig(lag_compensation=False, tracking_error=0.0)), SpeedOracle(model)
    radii = np.array([s.radius for link in model.links for s in model.spheres if s.link == link.name])
    q, u, inside, outside, reports, count = np.array(model.home), np.zeros(model.n), 0.0, 0.0, 0, 0
    for k in range(steps):
        x = 0.75 + velocity * k * 1e-3
        if k % 120 == 0:
            wanted = rng.uniform(-2.0, 2.0, model.n)
        safety.observe([person(x, velocity=velocity, near=near)], k * 1e-3)
        result = safety(q, u, wanted, k * 1e-3, 0.0)
        speeds, distances = oracle.speeds(q, result.u), part_distances(oracle, radii, q, x)
        close = distances < NEAR.distance - 1e-4
        inside = max(inside, float(speeds[close].max(initial=0.0)))
        count += bool(close.any())
        outside = max(outside, float(speeds[~close].max()))
        reports += bool(result.flags & 8192)
        u = result.u
        q = q + 1e-3 * u
    return inside, outside, reports, count


@pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.slow)])
def test_parts_near_a_person_keep_the_contact_speed_and_others_may_be_faster(seed):
    inside, outside, reports, count = push(NEAR, seed=seed)
    assert count > 300
    assert reports == 0
    assert inside <= NEAR.speed
    assert outside > 1.5 * NEAR.speed


def test_without_the_limit_the_parts_near_the_person_are_faster():
    inside, _, _, count = push(None)
    assert count > 300
    assert inside > 3.0 * NEAR.speed


def test_the_limit_also_holds_while_the_person_comes_nearer():
    """The ramp of the limit assumes the observed speed of the person, so the parts brake before she is near."""
    inside, _, reports, count = push(NEAR, velocity=-0.2)
    assert count > 300
    assert reports == 0
    assert inside <= NEAR.speed


def test_a_stamp_in_the_future_does_not_bring_a_person_farther_away():
    """The error of the velocity counts from the stamp on, and not backward: 4 ms before it the margin is that of it."""
    model, controls = load_robot("panda"), []
    for stamp in (0.0, 0.004):
        safety = SafetyFilter(
            model, FilterConfig(lag_compensation=False, tracking_error=0.0, acceleration_limits=False)
        )
        unsure = msgspec.structs.replace(person(1.0), velocity_error=0.3)
        safety.observe([unsure], stamp)
        result = safety(np.array(model.home), np.zeros(model.n), np.full(model.n, 2.0), 0.0, 0.0)
        assert result.status is FilterStatus.MODIFIED, "the limit near the person has an effect"
        controls.append(result.u)
    np.testing.assert_array_equal(*controls)


def test_limits_of_persons_by_name():
    def entry(name, role="person"):
        return SceneObject(name=name, role=role, shape=Capsule(0.1, 0.5), pose=Pose((1.0, 0.0, 0.5)))

    limits = PersonLimits(
        separation={"others": SpeedAndSeparation()}, near={"Ada": NEAR}, named=frozenset({"others", "Ada", "Bo"})
    )
    scene = Scene(
        robot="panda", stamp=0.0, version=1, objects=(entry("Ada"), entry("Bo"), entry("Cy"), entry("box", "obstacle"))
    )
    found = {one.name: one for one in obstacles_from_scene(scene, known=(), held=None, persons=limits)}
    assert found["Ada"].near == NEAR
    assert found["Ada"].separation is None
    assert found["Bo"].near is found["Bo"].separation is None
    assert found["Cy"].separation == SpeedAndSeparation()
    assert found["box"].near is found["box"].separation is None


SITE = """
[robot]
moving_mass = 18.0
load = 1.0
[person.others]
monitoring = "separation"
approach = 1.6
[person.operator]
monitoring = "power_and_force"
body_region = "hand"
distance = 0.4
"""


def test_a_site_file_chooses_per_person(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(SITE)
    limits = site_persons(read_site(path))
    assert limits.separation_of("visitor") == SpeedAndSeparation(0.1, 2.0, 1.6)
    assert limits.separation_of("operator") is None
    assert limits.near_of("visitor") is None
    assert limits.near_of("operator") == NearSpeed(contact_speed(BODY_REGIONS["hand"], 10.0), 0.4, 1.0, 0.0)
    path.write_text("")
    assert site_persons(read_site(path)) is None


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("moving_mass = 18.0", "", "moving_mass"),
        ('"hand"', '"torso"', "body region"),
        ('"hand"', '"skull"', "transient"),
        ('"hand"', '"own"', "source"),
        ("distance = 0.4", "approach = 5.0", "speed"),
        ("distance = 0.4", "pressure = 1e6", "area"),
        ('"power_and_force"', '"none"', "monitoring"),
    ],
)
def test_a_wrong_entry_of_a_site_file_is_reported_with_its_line(tmp_path, old, new, sentence):
    path = tmp_path / "lab.toml"
    path.write_text(SITE.replace(old, new))
    with pytest.raises(SiteError, match=rf"lab\.toml, line \d+.*{sentence}"):
        site_persons(read_site(path))


def test_an_entry_of_the_wrong_type_is_reported_with_its_line(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(SITE.replace("distance = 0.4", 'distance = "far"'))
    with pytest.raises(SiteError, match=r"lab\.toml, line 11, column 12: person\.operator\.distance must be a number"):
        site_persons(read_site(path))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('"power_and_force"\nbody_region = "hand"\nreaction = 0.1', 'use reaction; monitoring = "separation" does.'),
        ('"separation"\ndistance = 0.3', 'use distance; monitoring = "power_and_force" does.'),
        ('"barrier"\napproach = 0.0', 'approach; monitoring = "separation" or monitoring = "power_and_force" does.'),
        ('"power_and_force"\nbody_region = "hand"\nmass = 3.0', 'use mass; body_region = "own" does.'),
    ],
)
def test_an_entry_that_the_monitoring_does_not_use_is_refused(tmp_path, text, sentence):
    (tmp_path / "lab.toml").write_text(f"[person.operator]\nmonitoring = {text}\n")
    with pytest.raises(SiteError, match=rf"lab\.toml, line {2 + text.count(chr(10))}, .*{re.escape(sentence)}"):
        read_site(tmp_path / "lab.toml")


def test_own_numbers_of_a_region_need_a_source(tmp_path):
    path = tmp_path / "lab.toml"
    own = '"own"\nmass = 40.0\nstiffness = 25e3\nforce = 140.0\ntransient = 2.0\nsource = "measured at this cell"'
    path.write_text(SITE.replace('"hand"', own))
    expected = contact_speed(msgspec.structs.replace(BODY_REGIONS["chest"], source="measured at this cell"), 10.0)
    assert site_persons(read_site(path)).near_of("operator").speed == pytest.approx(expected)


@pytest.mark.parametrize("bad", [{"speed": 0.0}, {"distance": -1.0}, {"brake": 0.0}, {"approach": float("nan")}])
def test_a_limit_near_a_person_that_cannot_be_used_is_refused(bad):
    with pytest.raises(GeometryError, match="NearSpeed"):
        NearSpeed(**{"speed": 0.1} | bad)
