"""Random valid parameters: numbers uniform within their bounds, all choices equally likely."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dualbrain.contracts.contract import Action, ParameterValue
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter
from dualbrain.errors import ConfigurationError

MIN_GRID_STEPS = 10
"""Minimum number of grid steps (a power of ten) in a range, so that drawn numbers have few digits."""


def draw_action(
    registry: SkillRegistry, skill: str, given: Mapping[str, ParameterValue], rng: np.random.Generator
) -> Action:
    """`skill` with the `given` parameters; all others are drawn, without regard to their effect on a robot.

    Raises `ConfigurationError` for a name or text parameter that is not given.
    """
    drawn: dict[str, ParameterValue] = {}
    for parameter in registry.skill(skill).parameters:
        match parameter:
            case _ if parameter.name in given:
                drawn[parameter.name] = given[parameter.name]
            case NumberParameter():
                drawn[parameter.name] = draw_number(parameter, rng)
            case ChoiceParameter():
                drawn[parameter.name] = str(rng.choice(parameter.choices))
            case _:
                problem = f"The parameter {skill}.{parameter.name} is not given, and names and texts cannot be drawn."
                raise ConfigurationError.stating(problem)
    return Action(skill, drawn)


def draw_number(number: NumberParameter, rng: np.random.Generator) -> float:
    """A number within the bounds of `number`, on a grid of powers of ten; the lower bound if the range is empty."""
    span = number.upper - number.lower
    if span <= 0.0:
        return number.lower
    digits = -math.floor(math.log10(span / MIN_GRID_STEPS))
    scale = 10.0**digits
    first, last = math.ceil(number.lower * scale - 1e-9), math.floor(number.upper * scale + 1e-9)
    return round(int(rng.integers(first, last + 1)) / scale, max(digits, 0))
