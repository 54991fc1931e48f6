"""Every STOPPED and FAULT has a cause: each code is provoked, and no path of the kernel or of Python lacks one."""

import ast
import re
from contextlib import suppress
from pathlib import Path

import casadi as ca
import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import HalfSpace, Sphere
from dualbrain.errors import GeometryError
from dualbrain.records import Pose
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import CollisionSphere
from dualbrain.safety.cbf.filter import ConstraintRow, FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.cbf.result import FilterResult
from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter
from dualbrain.safety.higher_order import AccelerationFilter
from dualbrain.safety.stop_cause import REASON_TEXTS, REMEDIES, Reason, StopCause, stop_cause
from tests.safety import random_scenes

ROOT = Path(__file__).parents[3]
STOPPED, FAULT = FilterStatus.STOPPED, FilterStatus.FAULT
INFORMATION = (Reason.JERK, Reason.OVERSPEED, Reason.RETREAT)
"""Reasons that never stop a step."""


def make_filter(obstacles=(), robot=None, **settings):
    safety = SafetyFilter(robot or load_robot("panda"), random_scenes.exact_config(**settings))
    safety.observe(list(obstacles))
    return safety


def home():
    return np.array(load_robot("panda").home)


def state(q, stamp=0.0):
    return RobotState(stamp=stamp, sequence=0, q=q, v=np.zeros(7), opening=0.0, finger_forces=(0.0, 0.0))


def bad_input():
    return make_filter()(home(), np.zeros(7), np.array([0.0, 0.0, np.nan, 0.0, 0.0, 0.0, 0.0]))


def bad_scene():
    """An observation that is refused; the caller goes on."""
    safety = make_filter()
    with suppress(GeometryError):
        safety.observe([Obstacle("ghost", Sphere(0.05), Pose((np.nan, 0.0, 0.5)))])
    return safety(home(), np.zeros(7), np.zeros(7))


def stale_state():
    return make_filter().filter(state(home(), 0.0), np.zeros(7), 0.2)


def stale_scene():
    ball = Obstacle("ball", Sphere(0.05), Pose((2.0, 0.0, 0.5)), velocity=(0.1, 0.0, 0.0), static=False)
    return make_filter([ball])(home(), np.zeros(7), np.zeros(7), now=0.75)


def outside_limits():
    q = home()
    q[3] = 1.0
    return make_filter()(q, np.zeros(7), np.zeros(7))


def row_overflow():
    """More close obstacles than there are rows."""
    safety = make_filter()
    place = safety.tool(home()).position
    rng = np.random.default_rng(0)
    crowd = [Obstacle(f"o{k}", Sphere(0.01), Pose(tuple(place + rng.uniform(-0.1, 0.1, 3)))) for k in range(500)]
    safety.observe(crowd)
    return safety(home(), np.zeros(7), np.zeros(7))


def no_gradient():
    """A moving obstacle inside the first link, which no joint can move away from it."""
    post = Obstacle("post", Sphere(0.2), Pose((0.0, 0.0, 0.2)), static=False)
    return make_filter([post])(home(), np.zeros(7), np.zeros(7))


def qp_iterations():
    """A kernel with a limit of three iterations is in tests/kernel; here the result that such a step returns."""
    flags = int(Reason.QP_ITERATIONS)
    normal = make_filter()(home(), np.zeros(7), np.zeros(7))
    evidence = ((flags, 0, 0, 0, 80.0, 80.0),)
    return msgspec.structs.replace(normal, status=STOPPED, flags=flags, packed_evidence=evidence)


def unverified():
    """A kernel whose solver is too tolerant is in tests/kernel; here the result that such a step returns."""
    flags = int(Reason.UNVERIFIED | Reason.UNCERTIFIED)
    normal = make_filter([Obstacle("wall", HalfSpace(), Pose((0.0, 0.0, 0.0)))])(home(), np.zeros(7), np.zeros(7))
    evidence = ((int(Reason.UNCERTIFIED), 0, 20, 0, -1e-3, -2e-3),)
    return msgspec.structs.replace(normal, status=FAULT, flags=flags, packed_evidence=evidence, packed_rows=b"")


def one_sphere_robot(link):
    """A Panda with a single collision sphere, in the origin of `link`."""
    panda = load_robot("panda")
    pairs = msgspec.structs.replace(panda.self_pairs, kept=())
    return msgspec.structs.replace(panda, spheres=(CollisionSphere(link, (0.0, 0.0, 0.0), 0.05),), self_pairs=pairs)


def unavoidable():
    """A fast obstacle 1 mm in front of a sphere on the axis of the first joint."""
    post = Obstacle("post", Sphere(0.05), Pose((-0.101, 0.0, 0.333)), velocity=(3.0, 0.0, 0.0), static=False)
    return make_filter([post], one_sphere_robot("link1"))(home(), np.zeros(7), np.zeros(7))


def infeasible():
    """Two fast obstacles that close in on the hand from both sides."""
    safety = make_filter()
    tool = safety.tool(home()).position
    sides = (("left", 1.0), ("right", -1.0))
    places = {name: Pose(tuple(tool + np.array([0.0, 0.1 * sign, 0.0]))) for name, sign in sides}
    pair = [
        Obstacle(name, Sphere(0.05), places[name], velocity=(0.0, -3.0 * sign, 0.0), static=False)
        for name, sign in sides
    ]
    safety.observe(pair)
    return safety(home(), np.zeros(7), np.zeros(7))


def uncertified():
    """An obstacle inside the hand that moves faster than the hand can."""
    safety = make_filter(robot=one_sphere_robot("hand"))
    place = safety.spheres(home(), 0.0)[0][0] - np.array([0.0, 0.0, 0.01])
    safety.observe([Obstacle("ball", Sphere(0.05), Pose(tuple(place)), velocity=(0.0, 0.0, 3.0), static=False)])
    return safety(home(), np.zeros(7), np.zeros(7))


PROVOKED = {
    StopCause.BAD_INPUT: (bad_input, STOPPED),
    StopCause.BAD_SCENE: (bad_scene, STOPPED),
    StopCause.STALE_STATE: (stale_state, STOPPED),
    StopCause.STALE_SCENE: (stale_scene, STOPPED),
    StopCause.OUTSIDE_LIMITS: (outside_limits, STOPPED),
    StopCause.ROW_OVERFLOW: (row_overflow, STOPPED),
    StopCause.NO_GRADIENT: (no_gradient, STOPPED),
    StopCause.QP_ITERATIONS: (qp_iterations, STOPPED),
    StopCause.UNVERIFIED: (unverified, FAULT),
    StopCause.UNAVOIDABLE: (unavoidable, FAULT),
    StopCause.INFEASIBLE: (infeasible, FAULT),
    StopCause.UNCERTIFIED: (uncertified, FAULT),
}


def test_every_cause_has_a_provocation():
    """Fails for a new cause until it is provoked here."""
    assert set(PROVOKED) == set(StopCause) - {StopCause.UNKNOWN}


@pytest.mark.parametrize("cause", PROVOKED, ids=str)
def test_each_cause_is_a_code_with_a_text_numbers_and_a_remedy(cause):
    provoke, status = PROVOKED[cause]
    result = provoke()
    assert isinstance(result, FilterResult)
    assert (result.status, result.cause) == (status, cause)
    assert isinstance(result.cause, StopCause)
    text = result.explain()
    assert REASON_TEXTS[cause.name] in text
    assert text.endswith(f"remedy: {REMEDIES[cause]}")
    assert re.search(r"\d", text.partition("remedy:")[0]), "numbers"
    assert "\n" not in text
    assert "remedy" not in result.explain(remedy=False)
    assert result.evidence


@pytest.mark.parametrize(
    ("provoke", "words"),
    [
        (bad_input, "u_nom[2] is nan"),
        (bad_scene, "the last update was refused: position of pose of obstacle 'ghost': got (nan, 0.0, 0.5)"),
        (stale_state, "age 200.0 ms, allowed are -5 to 50 ms"),
        (stale_scene, "age 750.0 ms, allowed are -5 to 500 ms"),
        (outside_limits, "panda_joint4 at 1.000, its limit is -0.070"),
        (row_overflow, "512 of at most 512 rows"),
        (no_gradient, "link1 vs 'post' at -1"),
        (unavoidable, "link1 vs 'post' at"),
        (uncertified, "hand vs 'ball' goes from h = -"),
    ],
)
def test_the_explanation_names_the_culprit(provoke, words):
    assert words in provoke().explain()


def test_each_kind_of_bad_input_is_named():
    zeros, nan = np.zeros(7), np.full(7, np.nan)
    safety = make_filter()
    assert "q[0] is nan" in safety(nan, zeros, zeros).explain()
    assert "v[0] is nan" in safety(home(), nan, zeros).explain()
    assert "u_nom[0] is inf" in safety(home(), zeros, np.full(7, np.inf)).explain()
    assert "the opening is 0.2 m" in safety(home(), zeros, zeros, opening=0.2).explain()
    base = load_robot("mobile_panda")
    mobile = make_filter(robot=base)
    q = np.array(base.home)
    q[0] = np.nan
    assert "position of the base[0] is nan" in mobile(q, np.zeros(base.n), np.zeros(base.n)).explain()


def test_every_refused_update_is_named_until_it_is_replaced():
    safety = make_filter([Obstacle("wall", HalfSpace(), Pose((0.0, 0.0, -1.0)))])

    def explained():
        return safety(home(), np.zeros(7), np.zeros(7)).explain()

    with pytest.raises(GeometryError):
        safety.constrain([ConstraintRow(name="mine", a=(np.nan,) * 7, b=0.0)])
    assert "row 'mine'" in explained()
    with pytest.raises(GeometryError):
        safety.attach([[0.0, 0.0, 0.0, -0.1]], 0.0)
    assert "row 'mine'" in explained()
    assert "radius of a held sphere" in explained()
    safety.constrain([])
    assert "row 'mine'" not in explained()
    assert "radius of a held sphere" in explained()
    safety.detach()
    assert safety(home(), np.zeros(7), np.zeros(7)).cause == ""


def test_a_batch_reports_the_cause_of_every_state():
    q = np.tile(home(), (3, 1))
    q[1, 0], q[2, 3] = np.nan, 1.0
    result = make_filter().batch(q, np.zeros((3, 7)), np.zeros((3, 7)))
    assert result.causes == (None, StopCause.BAD_INPUT, StopCause.OUTSIDE_LIMITS)
    assert result.flags.tolist() == [0, int(Reason.BAD_INPUT), int(Reason.OUTSIDE_LIMITS)]


def test_results_that_are_not_stops_have_no_stop_cause():
    result = make_filter()(home(), np.zeros(7), np.zeros(7))
    assert result.cause == ""
    assert not isinstance(result.cause, StopCause)
    assert result.evidence == ()
    assert bad_input().unfiltered().evidence == ()


# --- no path without a cause ----------------------------------------------------------------------------------------


def kernel_flags():
    """Name and bit of every flag in the header of the kernel."""
    text = (ROOT / "kernel/include/dbk/dbk.h").read_text()
    block = text[text.index("/* reasons for the status of a step") :]
    return {name: int(bit) for name, bit in re.findall(r"DBK_(\w+) = (\d+)", block[: block.index("};")])}


def test_every_flag_of_the_kernel_is_a_reason_with_a_cause_and_texts():
    bits = kernel_flags()
    assert sorted(bits.values()) == sorted(int(reason) for reason in Reason)
    for reason in Reason:
        if reason in INFORMATION:
            continue
        assert stop_cause(int(reason)) is StopCause[reason.name]
        assert REASON_TEXTS[reason.name]
        assert REMEDIES[StopCause[reason.name]]
    assert set(REMEDIES) == set(StopCause)
    assert stop_cause(0) is StopCause.UNKNOWN
    assert stop_cause(int(Reason.JERK)) is StopCause.UNKNOWN


def test_the_kernel_stops_only_where_it_sets_a_flag():
    """The statements that end a step with STOPPED or FAULT; a new one must be added here with its flags."""
    text = (ROOT / "kernel/src/dbk_step.c").read_text()
    ends = [line.strip() for line in text.splitlines() if re.search(r"DBK_(STOPPED|FAULT)\b", line)]
    assert ends == [
        "return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);",  # reject: flags of the input, not 0
        "return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);",  # ROW_OVERFLOW or NO_GRADIENT
        "if (flags & DBK_QP_ITERATIONS) { return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out); }",
        "if (!certified) { return finish(model, ctx, in, DBK_FAULT, flags | DBK_UNCERTIFIED, 0, u, out); }",
        "return DBK_STOPPED;",  # dbk_project: an input that is rejected, and the same reasons
    ]
    assert "if (rejected) { return reject(" in text
    assert "if (flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT)) {" in text


def test_python_code_returns_no_stop_without_a_reason():
    """Every call in the package that passes STOPPED or FAULT also passes a `Reason`, or flags that are not empty."""
    found = []
    for path in sorted((ROOT / "src").rglob("*.py")):
        for call in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)):
            arguments = [*call.args, *(keyword.value for keyword in call.keywords)]
            names = [ast.unparse(argument) for argument in arguments]
            if {"FilterStatus.STOPPED", "FilterStatus.FAULT"} & set(names):
                reasoned = any(name.startswith("Reason.") or name == "faults" for name in names)
                found.append((path.name, ast.unparse(call.func), reasoned))
    unreasoned = [entry for entry in found if not entry[2]]
    assert [entry[:2] for entry in unreasoned] == [("filter.py", "FilteredAcceleration")]  # replaced before it returns
    assert len(found) == 5


# --- the other filters ----------------------------------------------------------------------------------------------


def test_the_control_affine_filter_states_cause_numbers_and_remedy():
    x = ca.SX.sym("x", 1)
    safety = ControlAffineFilter(
        ControlAffine(x, [0], [1]), [Barrier(name="wall", h=1.0 - x[0], alphas=(1.0,))], -1.0, 1.0
    )
    for x, u, words in (([np.nan], [0.0], "x[0] is nan"), ([0.0], [np.inf], "u_nom[0] is inf")):
        result = safety(np.array(x), np.array(u))
        assert (result.status, result.cause) == (STOPPED, StopCause.BAD_INPUT)
        assert words in result.explain()
        assert result.explain().endswith(f"remedy: {REMEDIES[StopCause.BAD_INPUT]}")
    assert safety(np.zeros(1), np.zeros(1)).cause is None


@pytest.mark.parametrize(
    ("change", "cause", "words"),
    [
        ({"q": np.nan}, StopCause.BAD_INPUT, "q[0] is nan"),
        ({"v": 99.0}, StopCause.BAD_INPUT, "v[0] is 99"),
        ({"u": np.inf}, StopCause.BAD_INPUT, "u_nom[0] is inf"),
        ({"now": np.nan}, StopCause.BAD_INPUT, "now is nan"),
        ({"opening": np.inf}, StopCause.BAD_INPUT, "opening is inf"),
        ({"q": 9.0}, StopCause.OUTSIDE_LIMITS, "panda_joint1 at 9.000"),
        ({"now": 0.75}, StopCause.STALE_SCENE, "age 750.0 ms"),
        ({"scene": np.nan}, StopCause.BAD_SCENE, "'ball'"),
    ],
)
def test_the_acceleration_filter_states_cause_numbers_and_remedy(change, cause, words):
    safety = AccelerationFilter(load_robot("panda"))
    place = (change.get("scene", 2.0), 0.0, 0.5)
    with suppress(GeometryError):
        safety.observe([Obstacle("ball", Sphere(0.05), Pose(place), velocity=(0.1, 0.0, 0.0), static=False)])
    q, v, u = home(), np.zeros(7), np.zeros(7)
    for array, name in ((q, "q"), (v, "v"), (u, "u")):
        array[0] = change.get(name, array[0])
    result = safety(q, v, u, now=change.get("now", 0.0), opening=change.get("opening", 0.0))
    assert (result.status, result.cause) == (STOPPED, cause)
    assert words in result.explain()
    assert result.explain().endswith(f"remedy: {REMEDIES[cause]}")
    assert safety(home(), np.zeros(7), np.zeros(7)).status is not STOPPED or "scene" in change
