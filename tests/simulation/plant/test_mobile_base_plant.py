"""The mobile base plant: wheels without slip, the stated lag, brakes, and the safety monitor."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.differential_drive import control_displacement
from dualbrain.robots.interface import Command
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.generators.rooms import ROOM_FAMILIES, make_room
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, load_scene, save_scene
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.placement import parse_goal
from tests.simulation.mobile_base_cell import MOBILE_BASE, MobileBaseCell

AMAX = np.array([joint.acceleration.value for joint in MOBILE_BASE.joints])
VMAX = np.array([joint.velocity.value for joint in MOBILE_BASE.joints])


def drive(plant, u):
    plant.write(Command(np.array(u, float), 0.0, 0.0))
    plant.advance()


@pytest.mark.parametrize("seed", range(3))
def test_the_stated_tracking_model_bounds_the_plant(seed):
    """|∫ exp(−α (t − s)) (ẏ − u) ds| ≤ e with y = q + lag v, along the driven path."""
    plant, rng = MobileBaseCell().plant, np.random.default_rng(seed)
    plant.set_configuration(np.array([2.0, 0.0, rng.uniform(-3, 3)]))
    decay, error, u, target = (
        np.exp(-MOBILE_BASE.tracking.rate * MOBILE_BASE.period),
        np.zeros(2),
        np.zeros(2),
        np.zeros(2),
    )
    before = plant.read()
    for step in range(400):
        if step % 20 == 0:
            target = rng.uniform(-1, 1, 2) * VMAX * (0.5, 1.0)
        u = u + np.clip(target - u, -AMAX * MOBILE_BASE.period, AMAX * MOBILE_BASE.period)
        drive(plant, u)
        after = plant.read()
        moved = control_displacement(before.q, after.q) + MOBILE_BASE.tracking.lag * (after.v - before.v)
        error = decay * error + moved - u * MOBILE_BASE.period
        before = after
        assert np.abs(error).max() <= MOBILE_BASE.tracking.position_error


def test_the_axle_never_moves_sideways():
    plant = MobileBaseCell().plant
    for step in range(150):
        before = plant.read().q
        drive(plant, (0.4, np.sin(0.1 * step)))
        dx, dy, turn = plant.read().q - before
        heading = before[2] + 0.5 * turn
        assert abs(dy * np.cos(heading) - dx * np.sin(heading)) < 1e-4


def test_the_wheels_respect_their_limits_for_any_command():
    plant, rng = MobileBaseCell().plant, np.random.default_rng(1)
    fastest = np.zeros(2)
    for _ in range(400):
        drive(plant, rng.normal(size=2) * 10.0)
        fastest = np.maximum(fastest, np.abs(plant.read().v))
    assert (fastest > 0.9 * VMAX).all()
    assert (fastest <= 1.001 * VMAX).all()


def test_the_brakes_hold_a_base_without_its_drive():
    plant = MobileBaseCell().plant
    for _ in range(60):
        drive(plant, (0.6, 0.0))
    plant.stop()
    drive(plant, (0.6, 0.5))
    for _ in range(40):
        plant.advance()
    rest = plant.read()
    assert np.abs(rest.v).max() < 1e-3
    assert not rest.drive_enabled
    plant.enable()
    assert plant.read().drive_enabled


def test_the_monitor_sees_a_crash_and_a_base_that_is_too_fast():
    crate = ObjectSpec(
        name="crate",
        role="obstacle",
        shape=Box((0.1, 0.3, 0.2)),
        position=(0.8, 0.0, 0.2),
        mass=20.0,
        colour="oak",
        category="crate",
        fixed=True,
    )
    spec = make_room("empty_room", 0, "base")
    cell = MobileBaseCell(spec=msgspec.structs.replace(spec, objects=(*spec.objects, crate)))
    cell.plant.data.qfrc_applied[0] = 2000.0  # external force [N], because the wheels limit the speed
    for _ in range(80):
        cell.plant.write(Command(np.array([0.6, 0.0]), 0.0, 0.0))
        cell.world.advance()
    found = {(one.kind, one.bodies) for one in cell.monitor.violations()}
    assert ("collision_env", ("crate", "link0")) in found
    assert ("joint_velocity", ("drive",)) in found


@pytest.mark.parametrize("family", ROOM_FAMILIES)
def test_rooms_are_reproducible_and_their_places_are_free(family, tmp_path):
    for seed in range(6):
        spec = make_room(family, seed, "base")
        assert spec == make_room(family, seed, "base")
        for place in spec.places:
            distances = [
                np.hypot(place.position[0] - t.position[0], place.position[1] - t.position[1]) for t in spec.objects
            ]
            assert min(distances) > 0.5
    save_scene(spec, tmp_path / "room.json")
    assert load_scene(tmp_path / "room.json") == spec


def test_scenes_and_goals_depend_on_the_robot():
    spec = open_scene("4", "base")
    assert spec.region
    assert parse_goal("go to the shelf", spec) == ArrivalGoal("shelf")
    assert parse_goal("bring yourself to the charger", spec) == ArrivalGoal("charger")
    with pytest.raises(UnknownNameError, match="place"):
        parse_goal("go to the moon", spec)
    with pytest.raises(ConfigurationError):
        parse_goal("put the red cube in the bowl", spec)
    with pytest.raises(UnknownNameError):
        open_scene("tabletop:1", "base")
    assert not open_scene("4").region
