"""Data sets with a cap on the samples of each kind."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.adaptation.curation.sample import Sample
from experiments.adaptation.exploration.balanced_samples import group_by_kind, largest_cap, sample_kind


def sample(number=0, *, speed=0.2, clearance=0.1, described="object", person="none", skills=("grasp", "place")):
    actions = [
        {
            "skill": skill,
            "params": {"object": "cup", "speed": speed, "clearance": clearance} if skill == "grasp" else {},
        }
        for skill in skills
    ]
    prompt = f"<scene>\ncup: fragile\n</scene>\n<scene>\ncup: {described}\nperson: {person}\n</scene>"
    return Sample(
        id=str(number),
        prompt=[{"role": "user", "content": prompt}],
        completion=[{"role": "assistant", "content": json.dumps({"action_sequence": actions})}],
        weight=1.0,
        Delta=0.0,
        duration=1.0,
        repeats=1,
        scene="",
        memory="",
        events=(number,),
        source="templates",
        graspable=(),
        receptive=(),
    )


def test_the_kind_has_choice_object_and_person():
    plain = ("grasp", "place"), 0.2, 0, False, False
    assert sample_kind(sample()) == plain
    assert sample_kind(sample(speed=0.35)) == (plain[0], 0.35, *plain[2:])
    assert [sample_kind(sample(clearance=height))[2] for height in (0.15, 0.16, 0.28, 0.29)] == [0, 1, 1, 2]
    assert sample_kind(sample(described="object, fragile"))[3] is True
    assert sample_kind(sample(person="near"))[4] is True
    assert sample_kind(sample(skills=("decline",))) == (("decline",),)


def test_samples_of_a_kind_keep_their_order():
    samples = [sample(0), sample(1, speed=0.1), sample(2), sample(3, speed=0.1)]
    assert [[one.id for one in group] for group in group_by_kind(samples).values()] == [["0", "2"], ["1", "3"]]


@given(st.lists(st.integers(1, 40), max_size=8), st.integers(0, 200))
def test_the_cap_is_the_largest_that_fits(sizes, count):
    def total(cap):
        return sum(min(size, cap) for size in sizes)

    cap = largest_cap(sizes, count)
    assert total(cap) <= count
    assert cap == max(sizes, default=0) or total(cap + 1) > count


@pytest.mark.parametrize(("count", "cap"), [(0, 0), (6, 3), (7, 4), (100, 10)])
def test_caps_of_three_kinds(count, cap):
    assert largest_cap([10, 2, 1], count) == cap
