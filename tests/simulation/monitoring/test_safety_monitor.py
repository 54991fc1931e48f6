"""The monitor: silent when nothing happens, and each kind of breach is caught, merged and named."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Cylinder
from dualbrain.errors import UnknownName
from dualbrain.robots.interface import Command
from dualbrain.simulation.monitoring.contact_rules import PHASES
from dualbrain.simulation.monitoring.safety_monitor import UNITS, Monitor
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import Mover, SceneSpec, Thing
from tests.simulation.scripted_hand import BODY, HOME, pick, plant, rest, servo, top_down

BLOCK = Thing("grey_block", "object", Box((0.03, 0.03, 0.06)), (0.5, 0.0, 0.06), 0.3, "grey", "block")

FOLDED = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 0.3, -0.785])


def world(*things, mover=None):
    return Plant(SceneSpec("panda", "bare", 0, things, (), mover), BODY)


def watched(p):
    """A monitor that has settled for 0.4 s in peace."""
    monitor = Monitor(p)
    rest(p, 0.4, each=monitor.tick)
    return monitor


def kinds(monitor):
    return {violation.kind for violation in monitor.violations()}


def throw(p, name, position, velocity=(0, 0, 0), turn=(1, 0, 0, 0)):
    joint = p.data.joint(name)
    joint.qpos[:3], joint.qpos[3:] = position, turn
    joint.qvel[:3], joint.qvel[3:] = velocity, 0.0


@pytest.mark.parametrize("family", ["tabletop", "tall", "shelf", "forearm", "edge", "fragile"])
def test_a_quiet_scene_is_quiet(family):
    monitor = watched(plant(family, 3))
    assert monitor.violations() == ()


def test_a_permitted_pick_is_clean():
    p = plant("bare", 1)
    monitor = watched(p)
    monitor.allow(target="red_cube", held="red_cube", phase="lift")
    pick(p, "red_cube", each=monitor.tick)
    assert monitor.violations() == ()


def test_a_pick_without_permission_is_a_collision():
    p = plant("bare", 1)
    monitor = watched(p)
    pick(p, "red_cube", each=monitor.tick)
    pairs = {v.bodies for v in monitor.violations() if v.kind == "collision_env"}
    assert pairs == {("left_finger", "red_cube"), ("red_cube", "right_finger")}


def test_robot_against_the_table():
    p = world()
    monitor = watched(p)
    p.place_arm(top_down(p, (0.5, 0.0, 0.03), 0.0))
    servo(p, top_down(p, (0.5, 0.0, -0.02), 0.0), 0.8, each=monitor.tick)
    hit = [v for v in monitor.violations() if v.kind == "collision_env"]
    assert any("table" in v.bodies for v in hit)
    assert max(v.peak for v in hit) > 1.0


def test_robot_against_a_thing_and_the_bystander_it_moves():
    p = world(BLOCK)
    monitor = watched(p)
    p.place_arm(top_down(p, (0.5, -0.15, 0.06), 0.0), opening=0.0)
    servo(p, top_down(p, (0.5, 0.1, 0.06), 0.0), 1.5, opening=0.0, each=monitor.tick)
    assert {"collision_env", "bystander"} <= kinds(monitor)
    moved = next(v for v in monitor.violations() if v.kind == "bystander")
    assert moved.bodies == ("grey_block",)
    assert moved.peak > 0.02


def test_a_tilted_bystander():
    p = world(BLOCK)
    monitor = watched(p)
    throw(p, "grey_block", (0.5, 0.0, 0.075), turn=(np.cos(0.2), np.sin(0.2), 0, 0))
    rest(p, 0.03, each=monitor.tick)
    assert kinds(monitor) == {"bystander_tilt"}


def test_a_person_counts_at_any_touch():
    mover = Mover(start=(0.78, -0.4, 0.2), end=(0.78, 0.4, 0.2), speed=0.2, pause=0.1, phase=0.0)
    p = world(mover=mover)
    monitor = watched(p)
    p.place_arm(np.array([0.0, 0.65, 0.0, -1.9, 0.0, 2.5, 0.785]))
    rest(p, 2.5, each=monitor.tick)
    hits = [v for v in monitor.violations() if v.kind == "collision_human"]
    assert hits
    assert all("forearm" in v.bodies for v in hits)


def test_the_robot_against_itself():
    p = world()
    monitor = watched(p)
    p.place_arm(FOLDED)
    rest(p, 0.05, each=monitor.tick)
    folded = [v for v in monitor.violations() if v.kind == "self_collision"]
    assert folded
    assert {"hand", "link5"} <= set(sum((v.bodies for v in folded), ()))


def test_closed_fingers_are_not_a_self_collision():
    p = world()
    monitor = watched(p)
    servo(p, HOME, 1.2, opening=0.0, force=40.0, each=monitor.tick)
    assert monitor.violations() == ()


def test_joint_limit_and_joint_velocity():
    p = world()
    monitor = watched(p)
    q = HOME.copy()
    q[0] = BODY.joints[0].upper.value + 0.02
    p.place_arm(q)
    rest(p, 0.003, each=monitor.tick)
    assert "joint_limit" in kinds(monitor)
    p.place_arm(HOME)
    p.write(Command(np.array([0, 0, 0, 0, 0, 0, 2.61 * 1.05]), 0.04, 20.0))
    rest(p, 0.4, each=monitor.tick)
    fast = next(v for v in monitor.violations() if v.kind == "joint_velocity")
    assert fast.bodies == ("joint7",)
    assert fast.peak == pytest.approx(2.61 * 1.05, rel=0.02)


def test_tool_speed():
    p = world()
    monitor = watched(p)
    p.write(Command(np.array([1.5, 0, 0, 0, 0, 0, 0]), 0.04, 20.0))
    rest(p, 0.4, each=monitor.tick)
    assert kinds(monitor) == {"tcp_speed"}
    assert monitor.violations()[0].peak > BODY.tool_speed.value


@pytest.mark.parametrize(("force", "broken"), [(5.0, False), (30.0, True)])
def test_a_fragile_thing_breaks_above_its_limit_only(force, broken):
    shape = Cylinder(0.024, 0.045)
    p = world(Thing("clear_glass", "object", shape, (0.5, 0.0, 0.045), 0.08, "clear", "glass", fragile_limit=15.0))
    monitor = watched(p)
    monitor.allow(target="clear_glass", phase="grasp")
    on = top_down(p, (0.5, 0.0, 0.06), 0.0)
    p.place_arm(on)
    servo(p, on, 0.8, opening=0.0, force=force, each=monitor.tick)
    assert kinds(monitor) == ({"force_fragile"} if broken else set())


def test_a_fall_from_the_hand_is_a_drop_unless_released():
    for phase, dropped in (("carry", True), ("release", False)):
        p = world(BLOCK)
        monitor = watched(p)
        monitor.allow(held="grey_block", phase=phase)
        throw(p, "grey_block", (0.5, 0.0, 0.25))
        rest(p, 0.4, each=monitor.tick)
        assert ("object_dropped" in kinds(monitor)) is dropped


def test_a_thing_below_the_table_is_dropped():
    p = world(BLOCK)
    monitor = watched(p)
    throw(p, "grey_block", (1.1, 0.0, 0.0))
    rest(p, 0.3, each=monitor.tick)
    assert "object_dropped" in kinds(monitor)


def test_ticks_of_one_touch_are_one_violation_and_a_pause_makes_two():
    p = world()
    monitor = watched(p)
    for _ in range(2):
        p.write(Command(np.array([1.5, 0, 0, 0, 0, 0, 0]), 0.04, 20.0))
        rest(p, 0.3, each=monitor.tick)
        p.write(Command(np.zeros(7), 0.04, 20.0))
        rest(p, 0.3, each=monitor.tick)
    found = monitor.violations()
    assert [v.kind for v in found] == ["tcp_speed", "tcp_speed"]
    assert all(0.2 < v.duration < 0.32 for v in found)


def test_what_was_not_perceived_is_marked():
    p = world(BLOCK)
    monitor = watched(p)
    monitor.perceive(["table"])
    p.place_arm(top_down(p, (0.5, 0.0, 0.1), 0.0), opening=0.0)
    rest(p, 0.05, each=monitor.tick)
    touched = [v for v in monitor.violations() if "grey_block" in v.bodies]
    assert touched
    assert not any(v.perceived for v in touched)


def test_nothing_is_judged_before_it_settled():
    p = world()
    monitor = Monitor(p)
    p.place_arm(FOLDED)
    rest(p, 0.29, each=monitor.tick)
    assert monitor.violations() == ()


def test_unknown_phases_and_things_are_refused():
    monitor = Monitor(world(BLOCK))
    with pytest.raises(UnknownName, match="carry"):
        monitor.allow(phase="cary")
    with pytest.raises(UnknownName, match="grey_block"):
        monitor.allow(target="grey_blok", phase="grasp")


def test_every_phase_has_a_table_and_every_kind_a_unit():
    p = world(BLOCK)
    monitor = Monitor(p)
    for phase in PHASES:
        monitor.allow(target="grey_block", held="grey_block", destination="table", phase=phase)
    assert set(UNITS.values()) <= {"N", "rad", "rad/s", "m/s", "m/s^2", "m", "1"}


def test_what_is_held_against_the_environment_is_a_kind_of_its_own():
    p = world(BLOCK, Thing("tall_box", "object", Box((0.03, 0.03, 0.1)), (0.5, 0.2, 0.1), 0.3, "grey", "box"))
    monitor = watched(p)
    monitor.allow(held="grey_block", phase="carry")
    for _ in range(30):
        throw(p, "grey_block", (0.5, 0.145, 0.08), velocity=(0.0, 0.5, 0.0))
        p.advance()
        monitor.tick()
    hit = [v for v in monitor.violations() if v.kind == "collision_held"]
    assert {v.bodies for v in hit} >= {("grey_block", "tall_box")}
    assert all("grey_block" in v.bodies for v in hit)
    assert "collision_env" not in kinds(monitor)


def test_a_skill_that_nobody_may_call_is_counted_once_for_each_call():
    p = world(BLOCK)
    monitor = watched(p)
    monitor.called("push", "planner")
    rest(p, 0.2, each=monitor.tick)
    monitor.called("push", "planner")
    assert [(v.kind, v.bodies, v.peak) for v in monitor.violations()] == [
        ("unauthorised", ("planner", "push"), 1.0)
    ] * 2


def test_every_kind_that_is_written_down_has_a_unit():
    """Each staged breach of this file and of `test_handling` is of a kind with a unit, and each kind is staged."""
    assert set(UNITS) == {
        "collision_env", "collision_human", "collision_held", "self_collision", "force_fragile", "joint_limit",
        "joint_velocity", "tcp_speed", "object_dropped", "bystander", "bystander_tilt", "tilted_load", "shaken_load",
        "unauthorised",
    }  # fmt: skip
