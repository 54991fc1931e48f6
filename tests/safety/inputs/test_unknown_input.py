"""Everything unknown counts as the worst case: openings, moving obstacles, clocks, and refused updates."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, Cylinder, Pose, Sphere
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.collision_model.opening_hull import opening_hull
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import ConstraintRow, Contact, FilterConfig, FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.cbf.grasped_object import cover_with_spheres
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.safety.cbf.result import Reason
from dualbrain.safety.higher_order.filter import AccelerationFilter
from dualbrain.safety.integration.shadow_mode import ShadowFilter
from tests.safety import geometry_oracle

EXACT = FilterConfig(lag_compensation=False, tracking_error=0.0)
ARMS = ("panda", "fr3", "ur5e")
STEPS = 1000


def drive_to_post(robot, opened, **known):
    """Least distance [m] of the fingers, open by `opened` [m], to a post beside them toward which the hand moves."""
    robot_model = load_robot(robot)
    safety = SafetyFilter(robot_model, EXACT)
    q = np.array(robot_model.home)
    tool = safety.tool(q)
    slide = next(np.array(link.slide) for link in robot_model.links if any(link.slide))
    beside = tool.rotation @ slide
    place = tool.position + 0.12 * beside - (0.0, 0.0, 0.11)  # it ends 1 cm above the finger tips, below the hand
    post = Obstacle("post", Capsule(0.01, 0.11), Pose(tuple(place.tolist())))
    safety.observe([post])
    least, certified = np.inf, 0
    for step in range(STEPS):
        J = safety.tool(q).jacobian
        u_nom = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), np.concatenate([0.1 * beside, np.zeros(3)]))
        result = safety(q, np.zeros(robot_model.n), u_nom, **known)
        certified += result.certified
        q = q + robot_model.period * result.u
        if step % 20 == 0:
            least = min(least, float(geometry_oracle.h_obstacles(robot_model, q[None], [post], opened)[0]))
    return least, certified


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_fingers_of_unknown_opening_do_not_touch_a_post(robot, share):
    opened = share * load_robot(robot).gripper.opening.value
    least, certified = drive_to_post(robot, opened)
    assert least >= 0.0
    assert certified > 0.9 * STEPS


def test_the_oracle_sees_open_fingers_touch_a_post_under_a_wrong_opening():
    """Control: if closed fingers are reported, the filter lets open ones in."""
    assert drive_to_post("panda", 0.04, opening=0.0)[0] < -0.005
    assert drive_to_post("panda", 0.04, opening=0.04)[0] >= 0.0


@pytest.mark.parametrize("robot", [*ARMS, "mobile_panda"])
def test_the_hull_contains_the_fingers_at_every_opening(robot, rng):
    robot_model = load_robot(robot)
    safety = SafetyFilter(robot_model)
    q = np.array(robot_model.home)
    hull, radii, groups = safety.spheres(q, None)
    fingers = np.array(groups) == "fingers"
    hull, radii = hull[fingers], radii[fingers]
    way = rng.normal(size=(80, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for opening in np.linspace(0.0, robot_model.gripper.opening.value, 13):
        centres, sizes, _ = safety.spheres(q, opening)
        surface = (centres[fingers, None] + sizes[fingers, None, None] * way).reshape(-1, 3)
        outside = np.linalg.norm(surface[:, None] - hull, axis=2) - radii
        assert outside.min(axis=1).max() < 1e-6


def test_the_hull_keeps_all_other_spheres_and_their_number(panda):
    hull = opening_hull(panda)
    assert len(hull.spheres) == len(panda.spheres)
    assert not any(any(link.slide) for link in hull.links)
    fingers = {link.name for link in panda.links if any(link.slide)}
    assert [s for s in hull.spheres if s.link not in fingers] == [s for s in panda.spheres if s.link not in fingers]
    base = load_robot("base")
    assert opening_hull(base) is base


@pytest.mark.parametrize("robot", ARMS)
def test_an_unknown_opening_never_sees_more_room_than_a_known_one(robot, rng):
    robot_model = load_robot(robot)
    safety = SafetyFilter(robot_model, FilterConfig(precision="float64"))
    n = robot_model.n
    low, high = (np.array([getattr(joint, side).value for joint in robot_model.joints]) for side in ("lower", "upper"))
    for _ in range(40):
        q = np.clip(np.array(robot_model.home) + rng.uniform(-0.6, 0.6, n), low, high)
        place = Pose(tuple((safety.tool(q).position + rng.uniform(-0.2, 0.2, 3)).tolist()))
        safety.observe([Obstacle("ball", Sphere(0.03), place)])
        unknown = safety(q, np.zeros(n), np.zeros(n)).h_min
        for opening in np.linspace(0.0, robot_model.gripper.opening.value, 5):
            assert unknown <= safety(q, np.zeros(n), np.zeros(n), opening=opening).h_min + 1e-9


def test_every_way_into_the_filter_treats_an_unknown_opening_alike(panda):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    tool = safety.tool(home)
    place = Pose(tuple((tool.position + tool.rotation @ (0.0, 0.085, 0.0)).tolist()))
    ball = Obstacle("ball", Sphere(0.02), place)
    safety.observe([ball])
    unknown, closed = safety(home, rest, rest).h_min, safety(home, rest, rest, opening=0.0).h_min
    assert unknown < closed - 0.005
    state = replace(home_state(panda), opening=None)
    assert safety.filter(state, rest, 0.0).h_min == unknown
    assert safety.batch([home], [rest], [rest]).h_min[0] == unknown
    assert safety.batch([home], [rest], [rest], opening=0.0).h_min[0] == closed
    shadow = ShadowFilter(SafetyFilter(panda, obstacles=[ball]))
    assert shadow.evaluate(home, rest, rest, 0.0).h_min == unknown
    assert np.array_equal(safety.project(state, rest, rest, 0.0), rest)
    higher = AccelerationFilter(panda)
    higher.observe([ball])
    assert higher(home, rest, rest).h_min < higher(home, rest, rest, opening=0.0).h_min - 0.005


@pytest.mark.parametrize("opening", [-0.01, 0.08, 0.0451, np.nan, np.inf])
def test_an_opening_that_the_gripper_cannot_have_is_a_bad_input(panda, opening):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    for result in (
        safety(home, rest, rest, opening=opening),
        safety.filter(replace(home_state(panda), opening=opening), rest, 0.0),
    ):
        assert (result.status, result.reason) == (FilterStatus.STOPPED, Reason.BAD_INPUT)
    assert safety.batch([home], [rest], [rest], opening=opening).status[0] == FilterStatus.STOPPED
    assert AccelerationFilter(panda)(home, rest, rest, opening=opening).reason is Reason.BAD_INPUT


# --- moving obstacles and clocks ----------------------------------------------------------------------------------

MOVING = {"velocity": {"velocity": (0.2, 0.0, 0.0)}, "velocity error": {"velocity_error": 0.1}}


@pytest.mark.parametrize("change", MOVING)
@pytest.mark.parametrize("static", [True, False])
def test_an_obstacle_with_a_velocity_becomes_stale_with_or_without_the_flag(panda, change, static):
    walker = Obstacle("walker", Sphere(0.1), Pose((2.0, 0.0, 0.5)), static=static, **MOVING[change])
    home, rest = np.array(panda.home), np.zeros(7)
    for make in (SafetyFilter, AccelerationFilter):
        safety = make(panda)
        safety.observe([walker], 0.0)
        assert safety(home, rest, rest, now=0.1).status is FilterStatus.SAFE
        for now in (0.51, 60.0):
            assert safety(home, rest, rest, now=now).reason is Reason.STALE_SCENE


def test_a_still_obstacle_does_not_become_stale(panda):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    safety.observe([Obstacle("box", Box((0.1, 0.1, 0.1)), Pose((2.0, 0.0, 0.5)))], 0.0)
    assert safety(home, rest, rest, now=1e6).status is FilterStatus.SAFE


@pytest.mark.parametrize("speed", [(0.0, 0.0, 0.0), (0.2, 0.0, 0.0)])
def test_an_observation_from_the_future_is_stale_beyond_five_milliseconds(panda, speed):
    home, rest = np.array(panda.home), np.zeros(7)
    for make in (SafetyFilter, AccelerationFilter):
        safety = make(panda)
        safety.observe([Obstacle("box", Sphere(0.1), Pose((2.0, 0.0, 0.5)), velocity=speed)], 10.0)
        assert safety(home, rest, rest, now=9.9951).status is FilterStatus.SAFE
        for now in (9.99, 0.0, -1e9):
            assert safety(home, rest, rest, now=now).reason is Reason.STALE_SCENE
        assert not safety(home, rest, rest, now=np.nan).status < FilterStatus.STOPPED


def test_a_clock_lead_does_not_reduce_a_margin(panda):
    safety, home, rest = SafetyFilter(panda, FilterConfig(precision="float64")), np.array(panda.home), np.zeros(7)
    safety.observe([Obstacle("cloud", Sphere(0.1), Pose((0.9, 0.0, 0.5)), velocity_error=2.0)], 10.0)
    early, present = (safety(home, rest, rest, now=now).h_min for now in (9.996, 10.0))
    assert early == pytest.approx(present, abs=1e-9)


def test_a_scene_object_without_a_usable_stamp_is_refused():
    thing = SceneObject(name="thing", role="object", shape=Sphere(0.05), pose=Pose((0.5, 0.0, 0.1)))
    for stamp in (np.nan, np.inf, 10.1):
        scene = Scene(robot="panda", stamp=10.0, version=1, objects=(msgspec.structs.replace(thing, stamp=stamp),))
        with pytest.raises(GeometryError, match="stamp of scene object 'thing'"):
            obstacles_from_scene(scene, known=(), held=None)


# --- refused updates ----------------------------------------------------------------------------------------------

UNUSABLE = {
    "size below zero": Obstacle("x", Box((-0.05, 0.1, 0.1)), Pose((0.6, 0.0, 0.4))),
    "length below zero": Obstacle("x", Capsule(0.05, -0.5), Pose((0.6, 0.0, 0.4))),
    "margin below zero": Obstacle("x", Sphere(0.05), Pose((0.6, 0.0, 0.4)), margin=-1.0),
    "quaternion of zeros": Obstacle("x", Sphere(0.05), Pose((0.6, 0.0, 0.4), (0.0, 0.0, 0.0, 0.0))),
    "tiny quaternion": Obstacle("x", Sphere(0.05), Pose((0.6, 0.0, 0.4), (1e-170, 0.0, 0.0, 0.0))),
    "29 columns of 2 and 4": Obstacle("x", Sphere(0.05), Pose((0.6, 0.0), (1.0, 0.0, 0.0, 0.0)), velocity=(0.0,) * 4),
    "map coordinates": Obstacle("x", Sphere(0.05), Pose((5e5, 0.0, 0.4))),
    "another shape": Obstacle("x", Cylinder(0.05, 0.1), Pose((0.6, 0.0, 0.4))),
    "no shape": Obstacle("x", None, Pose((0.6, 0.0, 0.4))),
    "an unknown part": Obstacle("x", Sphere(0.05), Pose((0.6, 0.0, 0.4)), parts=("elbow",)),
    "too steep": Obstacle("x", Sphere(0.05), Pose((0.6, 0.0, 0.4)), alpha=1e3),
    "not an obstacle": "x",
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_after_a_refused_observation_no_step_is_certified_until_the_next(panda, name):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    good = Obstacle("good", Sphere(0.05), Pose((2.0, 0.0, 0.4)))
    safety.observe([good])
    assert safety(home, rest, rest).certified
    with pytest.raises((ConfigurationError, UnknownNameError)):
        safety.observe([good, UNUSABLE[name]])
    for _ in range(3):
        result = safety(home, rest, rest + 0.5)
        assert (result.status, result.certified) == (FilterStatus.STOPPED, False)
        assert Reason.BAD_SCENE in result.reason
        assert np.array_equal(result.u, rest)
        assert safety.rows() == ()
    assert np.all(safety.batch([home], [rest], [rest]).status == FilterStatus.STOPPED)
    safety.observe([good])
    assert safety(home, rest, rest).certified


@pytest.mark.parametrize("table", [None, 5, "thing", [None], [good := Obstacle("x", Sphere(0.1))] * 513])
def test_a_refused_table_counts_as_no_observation(panda, table):
    for make in (SafetyFilter, AccelerationFilter):
        safety, home, rest = make(panda), np.array(panda.home), np.zeros(7)
        with pytest.raises(GeometryError):
            safety.observe(table)
        assert Reason.BAD_SCENE in safety(home, rest, rest).reason


@pytest.mark.parametrize(
    ("spheres", "error"),
    [
        ([[0.0, 0.0, 0.05, -0.5]], 0.0),
        ([[0.0, 0.0, 0.05, 0.02]], -1.0),
        ([0.0, 0.0, 0.05, 0.02], 0.0),
        ([], 0.0),
        (np.empty((0, 4)), 0.0),
        ([[0.0, 0.0, 0.6, 0.02]], 0.0),
        ([[0.0, 0.0, 0.05, 0.02]] * 9, 0.0),
    ],
)
def test_after_a_refused_held_object_no_step_is_certified_until_the_next(panda, spheres, error):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    with pytest.raises(GeometryError):
        safety.attach(spheres, error)
    assert not safety(home, rest, rest).certified
    safety.observe(())
    assert not safety(home, rest, rest).certified, "the object in the hand is still unknown"
    safety.detach()
    assert safety(home, rest, rest).certified


def test_after_refused_rows_no_step_is_certified_until_the_next(panda):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    for rows in ([ConstraintRow(name="r", a=(1.0,) * 6, b=0.0)], [None], None):
        with pytest.raises(ConfigurationError):
            safety.constrain(rows)
        assert not safety(home, rest, rest).certified
    safety.constrain([])
    assert safety(home, rest, rest).certified


def test_after_a_refused_permit_no_contact_is_permitted(panda):
    safety, home, rest = SafetyFilter(panda), np.array(panda.home), np.zeros(7)
    tool = safety.tool(home).position
    safety.observe([Obstacle("cube", Sphere(0.02), Pose(tuple(tool.tolist())))])
    contacts = [Contact("fingers", "cube", 0.05), Contact("hand", "cube", 0.05)]
    safety.permit(contacts)
    free = safety(home, rest, rest).h_min
    for bad in ([Contact("fingers", "cube", np.inf)], [Contact("elbow", "cube", 0.1)], None):
        safety.permit(contacts)
        with pytest.raises((ConfigurationError, UnknownNameError)):
            safety.permit(bad)
        assert safety(home, rest, rest).h_min < free - 0.01


def test_a_base_beyond_a_kilometre_is_a_bad_input():
    robot_model = load_robot("mobile_panda")
    safety, rest = SafetyFilter(robot_model), np.zeros(robot_model.n)
    for far, stops in ((999.0, False), (1001.0, True), (5e5, True), (np.inf, True), (np.nan, True)):
        for axis in (0, 1):
            q = np.array(robot_model.home)
            q[axis] = far
            result = safety(q, rest, rest)
            assert (Reason.BAD_INPUT in result.reason, result.certified) == (stops, not stops)
    q = np.array(robot_model.home)
    q[2] = np.inf
    assert Reason.BAD_INPUT in safety(q, rest, rest).reason


def test_single_precision_resolves_the_margins_up_to_a_kilometre():
    """The error of h over 300 places within ±1 km stays below the margins that each row has for rounding and length."""
    robot_model = load_robot("mobile_panda")
    config = FilterConfig(tracking_error=0.0)
    single, double = (
        SafetyFilter(robot_model, msgspec.structs.replace(config, precision=p)) for p in ("float32", "float64")
    )
    rng, rest, worst = np.random.default_rng(5), np.zeros(robot_model.n), 0.0
    for _ in range(300):
        q = np.array(robot_model.home)
        q[:2] = rng.choice([-1.0, 1.0], 2) * rng.uniform(500.0, 999.0, 2)
        q[2] = rng.uniform(-3.0, 3.0)
        place = (q[0] + rng.uniform(-0.9, 0.9), q[1] + rng.uniform(-0.9, 0.9), rng.uniform(0.2, 1.4))
        ball = Obstacle("ball", Sphere(0.05), Pose(tuple(float(x) for x in place)))
        for safety in (single, double):
            safety.observe([ball])
        worst = max(worst, abs(single(q, rest, rest).h_min - double(q, rest, rest).h_min))
    assert worst < config.sampling_margin + config.rounding_margin


@pytest.mark.parametrize(
    "field", ["tracking_error", "rounding_margin", "sampling_margin", "self_margin", "recovery_speed"]
)
def test_a_configuration_below_zero_is_refused(field):
    for value in (-1.0, np.nan, np.inf, "0.1", True):
        with pytest.raises(GeometryError, match=field):
            FilterConfig(**{field: value})
        with pytest.raises(GeometryError, match=field):
            msgspec.structs.replace(FilterConfig(), **{field: value})
    for margins in ((), (0.01, -0.01), (0.01, np.nan), (0.01, "0.1")):
        with pytest.raises(GeometryError, match="tracking_error"):
            FilterConfig(tracking_error=margins)
    for age in ("scene_stale_after", "state_stale_after"):
        with pytest.raises(GeometryError, match=age):
            FilterConfig(**{age: np.inf})
    with pytest.raises(GeometryError, match="precision"):
        FilterConfig(precision="float16")


def test_a_grasped_capsule_is_covered_up_to_its_tips():
    capsule = SceneObject(name="pen", role="object", shape=Capsule(0.03, 0.1), pose=Pose((0.0, 0.0, 0.0)))
    spheres = cover_with_spheres(capsule, np.zeros(3), np.eye(3))
    for z in np.linspace(-0.1, 0.1, 41):
        for point in ((0.03, 0.0, z), (0.0, -0.03, z), (0.0, 0.0, np.sign(z) * 0.13)):
            assert np.min(np.linalg.norm(spheres[:, :3] - point, axis=1) - spheres[:, 3]) <= 1e-9


def test_an_error_shortens_a_long_or_deep_value(panda):
    deep = 1.0
    for _ in range(5000):
        deep = [deep]
    for value in ([0.0] * 10**6, deep, 10**6000):
        with pytest.raises(GeometryError) as caught:
            SafetyFilter(panda).observe([Obstacle("x" * 999, Sphere(value), Pose((0.0, 0.0, 9.0)))])
        assert len(str(caught.value)) < 600
