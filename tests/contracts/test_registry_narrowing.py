"""A vocabulary narrows another one by tighter bounds alone: other words, units or choices make it another."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.registry import Registry, narrows
from dualbrain.contracts.skill_spec import Choice, Name, SkillSpec, Text
from tests.contracts.contract_strategies import REGISTRY, SPEED, build_registry

MORE = SkillSpec("nod", "say yes")


def one(*parameters, robot="panda", more=()):
    return Registry(robot, (SkillSpec("do", "something", parameters), *more))


def within(low, high):
    return msgspec.structs.replace(SPEED, lower=low, upper=high)


@given(bounds=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_bounds_narrow_exactly_where_they_are_inside(bounds):
    (a, b), (c, d) = sorted(bounds[:2]), sorted(bounds[2:])
    inner, outer = one(within(a, b)), one(within(c, d))
    assert narrows(inner, outer) == (c <= a and b <= d)
    assert narrows(inner, inner)
    assert (narrows(inner, outer) and narrows(outer, inner)) == (inner.hash == outer.hash)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ((SPEED,), ()),
        ((), (SPEED,)),
        ((SPEED,), (msgspec.structs.replace(SPEED, name="pace"),)),
        ((SPEED,), (msgspec.structs.replace(SPEED, unit="rad/s"),)),
        ((SPEED,), (Text("speed", 9),)),
        ((Choice("way", ("left",)),), (Choice("way", ("left", "right")),)),
        ((Choice("way", ("left", "right")),), (Choice("way", ("left",)),)),
        ((Name("thing", "graspable"),), (Name("thing", "any"),)),
        ((Text("why", 10),), (Text("why", 9),)),
    ],
)
def test_other_parameters_units_and_choices_are_another_vocabulary(ours, theirs):
    assert not narrows(one(*ours), one(*theirs))


def test_other_skills_and_another_robot_are_another_vocabulary():
    for other in (one(SPEED, robot="ur5e"), one(SPEED, more=(MORE,))):
        assert not narrows(one(SPEED), other)
        assert not narrows(other, one(SPEED))
    assert narrows(REGISTRY, build_registry())
    assert narrows(one(Text("why", 9)), one(Text("why", 10)))
