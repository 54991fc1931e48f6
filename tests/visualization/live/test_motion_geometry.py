"""Geometry of the drawn signs: motion without the filter, nearest pair, steps of the plan."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.contracts.contract import Action
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.visualization.live.motion.motion_geometry import (
    GHOST_HORIZON_S,
    link_poses,
    nearest_pair,
    plan_steps,
    unfiltered_configuration,
)
from dualbrain.visualization.live.state_builder import StateBuilder, Tick, scene_margins
from tests.visualization.conftest import scene
from tests.visualization.sample_view_states import link_frames

PANDA = load_robot("panda")
HOME = np.array(PANDA.home)


def make_tick(**changes) -> Tick:
    """A tick in which the person slows the arm to a half."""
    base = Tick(
        t=1.0,
        scene=scene(),
        q=HOME,
        opening=0.03,
        u=np.full(7, 0.05),
        u_nom=np.full(7, 0.1),
        delta=0.02,
        h_min=0.01,
        status="MODIFIED",
        barriers=("obstacle",),
        pairs=(("hand", "forearm", 0.01),),
        in_contract=True,
        skill="place",
        phase="carry",
        action="NONE",
        check="",
    )
    return replace(base, **changes)


def test_link_poses_agree_with_independent_kinematics():
    expected = link_frames(PANDA, HOME, 0.03)
    for name, pose in link_poses(PANDA, HOME, 0.03).items():
        assert pose.position == pytest.approx(expected[name][:3, 3], abs=1e-9)
        assert np.allclose(quaternion_to_matrix(pose.quaternion), expected[name][:3, :3], atol=1e-9)


def test_the_unfiltered_motion_stays_within_the_joint_limits():
    free = unfiltered_configuration(PANDA, HOME, np.full(7, 0.1))
    assert free - HOME == pytest.approx(np.full(7, 0.1 * GHOST_HORIZON_S))
    limits = [(joint.lower.value, joint.upper.value) for joint in PANDA.joints]
    for u, bound in ((-100.0, 0), (100.0, 1)):
        assert unfiltered_configuration(PANDA, HOME, np.full(7, u)) == pytest.approx([one[bound] for one in limits])


def test_the_segment_has_the_length_of_its_clearance_and_ends_on_the_object():
    safety, perceived = SafetyFilter(PANDA), scene()
    centres, radii, _ = safety.spheres(HOME, 0.03)
    margins = scene_margins(perceived)
    forearm = perceived.find("forearm")
    away = np.linalg.norm(centres - np.array(forearm.pose.position), axis=1).argmin()
    ends = nearest_pair(
        perceived, margins, centres[[away]], radii[[away]], h_of(perceived, margins, centres[away], radii[away])
    )
    assert ends is not None
    start, end = np.array(ends)
    assert np.linalg.norm(start - centres[away]) == pytest.approx(radii[away], rel=1e-3)
    assert nearest_pair(perceived, margins, centres, radii, -5.0) is None
    assert nearest_pair(perceived, margins, centres, radii, np.nan) is None
    assert np.linalg.norm(end - start) > 0.0


def h_of(perceived, margins, centre, radius) -> float:
    """Clearance [m] of a sphere and the forearm, a capsule of radius 0.05 m and half length 0.13 m along x."""
    axis = np.array(perceived.find("forearm").pose.position)
    along = np.clip(centre[0] - axis[0], -0.13, 0.13)
    return float(np.linalg.norm(centre - axis - [along, 0.0, 0.0]) - 0.05 - radius - margins["forearm"])


def test_a_step_is_at_the_object_or_place_that_it_names():
    home = (0.3, 0.0, 0.5)
    actions = (
        Action("grasp", {"object": "red_cube"}),
        Action("place", {"destination": "bowl"}),
        Action("home", {}),
        Action("grasp", {"object": "absent"}),
    )
    steps = plan_steps(actions, scene(), home)
    assert [step.label for step in steps] == ["grasp red cube", "place at bowl", "home", "grasp absent"]
    assert steps[0].position == scene().find("red_cube").pose.position
    assert steps[2].position == steps[3].position == home


def test_a_state_shows_what_the_filter_changed():
    builder = StateBuilder(PANDA)
    state = builder.build(make_tick(), {}, ())
    assert state.situation.limit.is_person
    assert state.situation.speed_share == pytest.approx(0.5)
    assert state.limiting_links == {"hand"}
    assert np.array(state.nominal_velocity) == pytest.approx(2.0 * np.array(state.filtered_velocity))
    assert set(state.ghost) == {link.name for link in PANDA.links}


def test_a_state_without_a_change_by_the_filter_shows_no_ghost_and_no_tint():
    free = make_tick(u=np.full(7, 0.1), delta=0.0, pairs=())
    state = StateBuilder(PANDA).build(free, {}, ())
    assert state.ghost == {}
    assert state.limiting_links == frozenset()


def test_a_report_without_the_nominal_control_is_drawn_without_its_arrow():
    state = StateBuilder(PANDA).build(make_tick(u_nom=np.zeros(0)), {}, ())
    assert state.nominal_velocity is None
    assert state.ghost == {}


def test_the_steps_of_a_plan_are_marked():
    builder = StateBuilder(PANDA)
    builder.set_plan((Action("grasp", {"object": "red_cube"}), Action("home", {})), scene(), HOME)
    builder.begin_step(1)
    plan = builder.build(make_tick(), {}, ()).plan
    assert [(step.is_done, step.is_current) for step in plan] == [(True, False), (False, True)]
