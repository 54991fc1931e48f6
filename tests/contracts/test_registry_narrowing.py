"""A registry narrows another one only by tighter bounds: other names, units or choices make it a different one."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.registry import SkillRegistry, is_narrower
from dualbrain.contracts.skill_spec import ChoiceParameter, NameParameter, SkillSpec, TextParameter
from tests.contracts.contract_strategies import REGISTRY, SPEED, build_registry

MORE = SkillSpec("nod", "nod once")


def one(*parameters, robot="panda", more=()):
    return SkillRegistry(robot, (SkillSpec("do", "something", parameters), *more))


def within(low, high):
    return msgspec.structs.replace(SPEED, lower=low, upper=high)


@given(bounds=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_bounds_narrow_exactly_where_they_are_inside(bounds):
    (a, b), (c, d) = sorted(bounds[:2]), sorted(bounds[2:])
    inner, outer = one(within(a, b)), one(within(c, d))
    assert is_narrower(inner, outer) == (c <= a and b <= d)
    assert is_narrower(inner, inner)
    assert (is_narrower(inner, outer) and is_narrower(outer, inner)) == (inner.hash == outer.hash)


@pytest.mark.parametrize(
    ("inner", "outer"),
    [
        ((SPEED,), ()),
        ((), (SPEED,)),
        ((SPEED,), (msgspec.structs.replace(SPEED, name="pace"),)),
        ((SPEED,), (msgspec.structs.replace(SPEED, unit="rad/s"),)),
        ((SPEED,), (TextParameter("speed", 9),)),
        ((ChoiceParameter("way", ("left",)),), (ChoiceParameter("way", ("left", "right")),)),
        ((ChoiceParameter("way", ("left", "right")),), (ChoiceParameter("way", ("left",)),)),
        ((NameParameter("thing", "graspable"),), (NameParameter("thing", "any"),)),
        ((TextParameter("why", 10),), (TextParameter("why", 9),)),
    ],
)
def test_other_parameters_units_and_choices_make_a_different_registry(inner, outer):
    assert not is_narrower(one(*inner), one(*outer))


def test_other_skills_and_another_robot_make_a_different_registry():
    for other in (one(SPEED, robot="ur5e"), one(SPEED, more=(MORE,))):
        assert not is_narrower(one(SPEED), other)
        assert not is_narrower(other, one(SPEED))
    assert is_narrower(REGISTRY, build_registry())
    assert is_narrower(one(TextParameter("why", 9)), one(TextParameter("why", 10)))
