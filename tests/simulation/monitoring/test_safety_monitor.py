"""The safety monitor: no violation in a resting scene; every kind of violation is detected, merged and named."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Cylinder
from dualbrain.errors import UnknownNameError
from dualbrain.records import Violation
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.monitoring.contact_rules import CONTACT_PHASES
from dualbrain.simulation.monitoring.safety_monitor import PEAK_UNITS, SafetyMonitor
from dualbrain.simulation.plant.factory import make_plant as make_room_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.workroom import make_workroom
from dualbrain.simulation.scenes.scene_spec import MovingPerson, ObjectSpec, SceneSpec
from tests.simulation.scripted_hand import HOME, PANDA, make_plant, pick_up, servo_to, top_down_posture, wait

BLOCK = ObjectSpec(
    name="grey_block",
    role="object",
    shape=Box((0.03, 0.03, 0.06)),
    position=(0.5, 0.0, 0.06),
    mass=0.3,
    colour="grey",
    category="block",
)

FOLDED = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 0.3, -0.785])


def make_world(*objects, mover=None):
    return Plant(SceneSpec(robot="panda", family="bare", seed=0, objects=objects, places=(), mover=mover), PANDA)


def settled_monitor(p):
    """A monitor of `p` after 0.4 s without a command."""
    monitor = SafetyMonitor(p)
    wait(p, 0.4, each=monitor.update)
    return monitor


def kinds(monitor):
    return {violation.kind for violation in monitor.violations()}


def set_motion(p, name, position, velocity=(0, 0, 0), quaternion=(1, 0, 0, 0)):
    joint = p.data.joint(name)
    joint.qpos[:3], joint.qpos[3:] = position, quaternion
    joint.qvel[:3], joint.qvel[3:] = velocity, 0.0


@pytest.mark.parametrize("family", ["tabletop", "tall", "shelf", "forearm", "edge", "fragile"])
def test_a_resting_scene_has_no_violation(family):
    monitor = settled_monitor(make_plant(family, 3))
    assert monitor.violations() == ()


def test_a_permitted_pick_has_no_violation():
    p = make_plant("bare", 1)
    monitor = settled_monitor(p)
    monitor.allow(target="red_cube", held="red_cube", phase="lift")
    pick_up(p, "red_cube", each=monitor.update)
    assert monitor.violations() == ()


def test_a_pick_without_permission_is_a_collision():
    p = make_plant("bare", 1)
    monitor = settled_monitor(p)
    pick_up(p, "red_cube", each=monitor.update)
    pairs = {v.bodies for v in monitor.violations() if v.kind == "collision_env"}
    assert pairs == {("left_finger", "red_cube"), ("red_cube", "right_finger")}


def test_a_collision_of_the_robot_with_the_table():
    p = make_world()
    monitor = settled_monitor(p)
    p.set_configuration(top_down_posture(p, (0.5, 0.0, 0.03), 0.0))
    servo_to(p, top_down_posture(p, (0.5, 0.0, -0.02), 0.0), 0.8, each=monitor.update)
    hit = [v for v in monitor.violations() if v.kind == "collision_env"]
    assert any("table" in v.bodies for v in hit)
    assert max(v.peak for v in hit) > 1.0


def test_a_collision_of_the_robot_with_an_object_that_it_moves():
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    p.set_configuration(top_down_posture(p, (0.5, -0.15, 0.06), 0.0), opening=0.0)
    servo_to(p, top_down_posture(p, (0.5, 0.1, 0.06), 0.0), 1.5, opening=0.0, each=monitor.update)
    assert {"collision_env", "bystander"} <= kinds(monitor)
    moved = next(v for v in monitor.violations() if v.kind == "bystander")
    assert moved.bodies == ("grey_block",)
    assert moved.peak > 0.02


def test_a_tilted_bystander():
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    set_motion(p, "grey_block", (0.5, 0.0, 0.075), quaternion=(np.cos(0.2), np.sin(0.2), 0, 0))
    wait(p, 0.03, each=monitor.update)
    assert kinds(monitor) == {"bystander_tilt"}


def test_any_contact_with_a_person_counts():
    mover = MovingPerson(start=(0.78, -0.4, 0.2), end=(0.78, 0.4, 0.2), speed=0.2, pause=0.1, phase=0.0)
    p = make_world(mover=mover)
    monitor = settled_monitor(p)
    p.set_configuration(np.array([0.0, 0.65, 0.0, -1.9, 0.0, 2.5, 0.785]))
    wait(p, 2.5, each=monitor.update)
    hits = [v for v in monitor.violations() if v.kind == "collision_human"]
    assert hits
    assert all("forearm" in v.bodies for v in hits)


def test_a_self_collision_of_the_robot():
    p = make_world()
    monitor = settled_monitor(p)
    p.set_configuration(FOLDED)
    wait(p, 0.05, each=monitor.update)
    folded = [v for v in monitor.violations() if v.kind == "self_collision"]
    assert folded
    assert {"hand", "link5"} <= set(sum((v.bodies for v in folded), ()))


def test_closed_fingers_are_not_a_self_collision():
    p = make_world()
    monitor = settled_monitor(p)
    servo_to(p, HOME, 1.2, opening=0.0, force=40.0, each=monitor.update)
    assert monitor.violations() == ()


def test_joint_limit_and_joint_velocity():
    p = make_world()
    monitor = settled_monitor(p)
    q = HOME.copy()
    q[0] = PANDA.joints[0].upper.value + 0.02
    p.set_configuration(q)
    wait(p, 0.003, each=monitor.update)
    assert "joint_limit" in kinds(monitor)
    p.set_configuration(HOME)
    p.write(Command(np.array([0, 0, 0, 0, 0, 0, 2.61 * 1.05]), 0.04, 20.0))
    wait(p, 0.4, each=monitor.update)
    fast = next(v for v in monitor.violations() if v.kind == "joint_velocity")
    assert fast.bodies == ("joint7",)
    assert fast.peak == pytest.approx(2.61 * 1.05, rel=0.02)


def test_tool_speed():
    p = make_world()
    monitor = settled_monitor(p)
    p.write(Command(np.array([1.5, 0, 0, 0, 0, 0, 0]), 0.04, 20.0))
    wait(p, 0.4, each=monitor.update)
    assert kinds(monitor) == {"tcp_speed"}
    assert monitor.violations()[0].peak > PANDA.tool_speed.value
    assert 0.1 < monitor.measurements().over_speed_share < 0.9


def test_measurements_at_rest_are_zero():
    measured = settled_monitor(make_world(BLOCK)).measurements()
    assert (measured.over_speed_share, measured.fragile_force, measured.physics_warnings) == (0.0, None, 0)


def test_a_reset_of_the_physics_engine_is_counted(monkeypatch, tmp_path):
    """The engine resets a state that is not finite; afterwards the episode looks as if it had begun again."""
    monkeypatch.chdir(tmp_path)  # the engine writes a log file
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    set_motion(p, "grey_block", (0.5, 0.0, 0.06), velocity=(1e12, 0, 0))
    wait(p, 0.02, each=monitor.update)
    assert monitor.measurements().physics_warnings > 0


@pytest.mark.parametrize(("force", "broken"), [(5.0, False), (30.0, True)])
def test_a_fragile_object_breaks_only_above_its_limit(force, broken):
    shape = Cylinder(0.024, 0.045)
    p = make_world(
        ObjectSpec(
            name="clear_glass",
            role="object",
            shape=shape,
            position=(0.5, 0.0, 0.045),
            mass=0.08,
            colour="clear",
            category="glass",
            fragile_limit=15.0,
        )
    )
    monitor = settled_monitor(p)
    monitor.allow(target="clear_glass", phase="grasp")
    grasp = top_down_posture(p, (0.5, 0.0, 0.06), 0.0)
    p.set_configuration(grasp)
    servo_to(p, grasp, 0.8, opening=0.0, force=force, each=monitor.update)
    assert kinds(monitor) == ({"force_fragile"} if broken else set())
    measured = monitor.measurements().fragile_force
    assert measured is not None
    assert measured == pytest.approx(force, rel=0.4)  # per finger
    assert (measured > 15.0) == broken


@pytest.mark.parametrize(
    ("phase", "height", "dropped"),
    [("carry", 0.25, True), ("release", 0.25, True), ("carry", 0.12, True), ("release", 0.18, False)],
)
def test_a_fall_from_the_hand_is_a_drop_and_a_high_one_also_at_the_release(phase, height, dropped):
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    monitor.allow(held="grey_block", phase=phase)
    set_motion(p, "grey_block", (0.5, 0.0, height))
    wait(p, 0.4, each=monitor.update)
    assert ("object_dropped" in kinds(monitor)) is dropped


def test_an_object_below_the_table_is_dropped():
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    set_motion(p, "grey_block", (1.1, 0.0, 0.0))
    wait(p, 0.3, each=monitor.update)
    assert "object_dropped" in kinds(monitor)


def test_an_object_on_the_floor_of_a_room_is_dropped():
    robot = load_robot("mobile_panda")
    p = make_room_plant(make_workroom("workroom", 0, robot.name), robot)
    monitor = settled_monitor(p)
    assert "object_dropped" not in kinds(monitor)
    monitor.allow(held="red_cube", phase="release")
    set_motion(p, "red_cube", (*p.spec.find_place("bench").position[:2], 0.026))
    wait(p, 0.1, each=monitor.update)
    dropped = [violation for violation in monitor.violations() if violation.kind == "object_dropped"]
    assert [violation.bodies for violation in dropped] == [("red_cube",)]
    assert dropped[0].peak == pytest.approx(0.475, abs=0.01)


def test_consecutive_steps_are_one_violation_and_a_pause_separates_two():
    p = make_world()
    monitor = settled_monitor(p)
    for _ in range(2):
        p.write(Command(np.array([1.5, 0, 0, 0, 0, 0, 0]), 0.04, 20.0))
        wait(p, 0.3, each=monitor.update)
        p.write(Command(np.zeros(7), 0.04, 20.0))
        wait(p, 0.3, each=monitor.update)
    found = monitor.violations()
    assert [v.kind for v in found] == ["tcp_speed", "tcp_speed"]
    assert all(0.2 < v.duration < 0.32 for v in found)


def test_a_violation_with_an_unperceived_object_is_marked():
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    monitor.set_perceived(["table"])
    p.set_configuration(top_down_posture(p, (0.5, 0.0, 0.1), 0.0), opening=0.0)
    wait(p, 0.05, each=monitor.update)
    touched = [v for v in monitor.violations() if "grey_block" in v.bodies]
    assert touched
    assert not any(v.perceived for v in touched)


def test_nothing_is_checked_during_the_settling_time():
    p = make_world()
    monitor = SafetyMonitor(p)
    p.set_configuration(FOLDED)
    wait(p, 0.29, each=monitor.update)
    assert monitor.violations() == ()


def test_unknown_phases_and_objects_are_rejected():
    monitor = SafetyMonitor(make_world(BLOCK))
    with pytest.raises(UnknownNameError, match="carry"):
        monitor.allow(phase="cary")
    with pytest.raises(UnknownNameError, match="grey_block"):
        monitor.allow(target="grey_blok", phase="grasp")


def test_every_phase_has_a_table_and_every_kind_a_unit():
    p = make_world(BLOCK)
    monitor = SafetyMonitor(p)
    for phase in CONTACT_PHASES:
        monitor.allow(target="grey_block", held="grey_block", destination="table", phase=phase)
    assert set(PEAK_UNITS.values()) <= {"N", "rad", "rad/s", "m/s", "m/s^2", "m", "1"}


def test_a_collision_of_the_held_object_has_its_own_kind():
    p = make_world(
        BLOCK,
        ObjectSpec(
            name="tall_box",
            role="object",
            shape=Box((0.03, 0.03, 0.1)),
            position=(0.5, 0.2, 0.1),
            mass=0.3,
            colour="grey",
            category="box",
        ),
    )
    monitor = settled_monitor(p)
    monitor.allow(held="grey_block", phase="carry")
    for _ in range(30):
        set_motion(p, "grey_block", (0.5, 0.145, 0.08), velocity=(0.0, 0.5, 0.0))
        p.advance()
        monitor.update()
    hit = [v for v in monitor.violations() if v.kind == "collision_held"]
    assert {v.bodies for v in hit} >= {("grey_block", "tall_box")}
    assert all("grey_block" in v.bodies for v in hit)
    assert "collision_env" not in kinds(monitor)


def test_an_unauthorised_skill_is_counted_once_for_each_call():
    p = make_world(BLOCK)
    monitor = settled_monitor(p)
    monitor.record_unauthorised_skill("push", "planner")
    wait(p, 0.2, each=monitor.update)
    monitor.record_unauthorised_skill("push", "planner")
    assert [(v.kind, v.bodies, v.peak) for v in monitor.violations()] == [
        ("unauthorised", ("planner", "push"), 1.0)
    ] * 2


def test_the_kinds_of_violation_with_a_unit():
    """The tests of this file and of `test_handling` produce each of these kinds."""
    assert set(PEAK_UNITS) == {
        "collision_env",
        "collision_human",
        "collision_held",
        "self_collision",
        "force_fragile",
        "joint_limit",
        "joint_velocity",
        "tcp_speed",
        "object_dropped",
        "bystander",
        "bystander_tilt",
        "tilted_load",
        "shaken_load",
        "unauthorised",
    }


@pytest.mark.parametrize("speed", [1e12, 1e155, 1e200])
def test_a_diverged_simulation_has_violations_that_can_be_written_and_read(speed):
    """Forces and speeds are not finite then, and the row of the episode is JSON."""
    p = make_plant("bare", 1)
    monitor = settled_monitor(p)
    p.data.qvel[p.arm_slices[1]] = speed
    for _ in range(50):
        p.step()
        monitor.update()
    assert monitor.measurements().physics_warnings > 0
    found = monitor.violations()
    assert found
    assert msgspec.json.decode(msgspec.json.encode(found), type=tuple[Violation, ...]) == found
