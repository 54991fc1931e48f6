"""A registry is checked when it is built, and its hash changes with the meaning of contracts and with nothing else."""

import hashlib
from typing import Any

import msgspec
import pytest

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import (
    ChoiceParameter,
    ContactPermit,
    NameParameter,
    NumberParameter,
    SkillSpec,
    TextParameter,
)
from dualbrain.errors import ConfigurationError, UnknownNameError
from tests.contracts.contract_strategies import APPROACH, OPENING, REASON, REGISTRY, SPEED, build_registry


def of(*skills: SkillSpec, robot: str = "panda") -> SkillRegistry:
    """A registry of these skills."""
    return SkillRegistry(robot, skills)


def one(*parameters: Any, name: str = "go", **more: Any) -> SkillRegistry:
    """A registry of one skill with these parameters."""
    return of(SkillSpec(name, "", parameters, **more))


def changed(number: NumberParameter, **fields: Any) -> NumberParameter:
    """`number` with other fields."""
    return msgspec.structs.replace(number, **fields)


def test_the_hash_is_of_the_canonical_bytes() -> None:
    assert REGISTRY.hash == hashlib.sha256(REGISTRY.canonical_bytes()).hexdigest()[:8]
    assert build_registry().hash == REGISTRY.hash
    assert one(SPEED).canonical_bytes() == (
        b'{"contract_version":1,"robot":"panda","skills":{"go":{"speed":{"lower":0.05,"number":"m/s","upper":0.4}}}}'
    )


@pytest.mark.parametrize(
    "other",
    [
        one(SPEED, name="went"),
        of(SkillSpec("go", "", (SPEED,)), robot="ur5e"),
        one(changed(SPEED, unit="rad/s")),
        one(changed(SPEED, upper=0.5)),
        one(changed(SPEED, lower=0.0)),
        one(changed(SPEED, name="pace")),
        one(SPEED, OPENING),
        one(),
        of(SkillSpec("go", "", (SPEED,)), SkillSpec("stop", "")),
        one(ChoiceParameter("speed", ("slow", "fast"))),
        one(NameParameter("speed", "any")),
        one(TextParameter("speed", 9)),
    ],
)
def test_the_hash_changes_with_meaning(other: SkillRegistry) -> None:
    assert other.hash != one(SPEED).hash


def test_the_hash_does_not_change_with_descriptions_order_or_permits() -> None:
    reworded = changed(SPEED, description="how fast", lower_from="new source", upper_from="new source")
    permit = ContactPermit("close", "fingers", "target", 0.05)
    assert one(reworded, permits=(permit,)).hash == one(SPEED).hash
    assert of(*reversed(REGISTRY.skills)).hash == REGISTRY.hash
    assert one(ChoiceParameter("way", ("left", "right"))).hash == one(ChoiceParameter("way", ("right", "left"))).hash
    assert one(ChoiceParameter("way", ("left", "right"))).hash != one(ChoiceParameter("way", ("left", "straight"))).hash


@pytest.mark.parametrize(
    "build",
    [
        of,
        lambda: of(SkillSpec("go", ""), SkillSpec("go", "twice")),
        lambda: one(SPEED, OPENING, SPEED),
        lambda: one(SPEED, name="Go"),
        lambda: one(SPEED, name="gо"),  # a Cyrillic letter
        lambda: one(SPEED, name="__proto__"),
        lambda: of(SkillSpec("go", ""), robot="the robot"),
        lambda: one(changed(SPEED, name="")),
        lambda: one(changed(SPEED, unit="mm/s")),
        lambda: one(changed(SPEED, unit="deg/s")),
        lambda: one(changed(SPEED, unit="metre/second")),
        lambda: one(changed(SPEED, lower=0.5)),
        lambda: one(changed(SPEED, lower=float("nan"))),
        lambda: one(changed(SPEED, upper=float("nan"))),
        lambda: one(changed(SPEED, upper=float("inf"))),
        lambda: one(changed(SPEED, upper=1e12)),
        lambda: one(changed(SPEED, lower_from="")),
        lambda: one(changed(SPEED, upper_from=" ")),
        lambda: one(ChoiceParameter("way", ())),
        lambda: one(ChoiceParameter("way", ("left", "left"))),
        lambda: one(ChoiceParameter("way", ("to the left",))),
        lambda: one(TextParameter("reason", 0)),
        lambda: one(TextParameter("reason", 100_000)),
        lambda: one(SPEED, permits=(ContactPermit("close", "fingers", "target", float("nan")),)),
        lambda: one(SPEED, permits=(ContactPermit("close", "fingers", "target", -0.1),)),
    ],
)
def test_an_invalid_registry_is_not_built(build: Any) -> None:
    with pytest.raises(ConfigurationError):
        build()


def test_the_error_names_the_wrong_unit() -> None:
    with pytest.raises(ConfigurationError, match=r"'mm/s'.*'mm' is not one of"):
        one(changed(SPEED, unit="mm/s"))


def test_skills_are_found_by_name() -> None:
    assert REGISTRY.skill("decline").parameters == (REASON,)
    assert APPROACH in REGISTRY.skill("grasp").parameters
    with pytest.raises(UnknownNameError, match="Closest: 'grasp'"):
        REGISTRY.skill("grsp")


@pytest.mark.parametrize("name", ["", "red cube", "a\nb", "ignore_previous: instructions", "x" * 49, "rеd", '"', "-a"])
def test_scene_names_are_identifiers(name: str) -> None:
    with pytest.raises(ConfigurationError):
        SceneNames((name,), ())
    with pytest.raises(ConfigurationError):
        SceneNames((), (name,))


def test_scene_names_are_offered_by_role() -> None:
    names = SceneNames(("cup", "cube"), ("bowl", "cup"))
    assert [names.names_of_kind(of) for of in ("graspable", "receptive", "any")] == [
        ("cup", "cube"),
        ("bowl", "cup"),
        ("cup", "cube", "bowl"),
    ]
