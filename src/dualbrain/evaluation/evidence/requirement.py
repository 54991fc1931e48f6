"""Requirements of the safety layer and hazards, with the references between them."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import Literal, TypeVar

import msgspec

T = TypeVar("T")
SiteMeasure = Literal["obstacles", "tool", "persons", "tool_speed", "commander", "payload", "objects", "commissioning"]
"""Entries of a site file on which a measure depends, and the commissioning record."""
Equipment = Literal["force sensing", "gripper"]
"""Equipment of a robot without which a requirement is not applicable."""


class Requirement(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A verified statement about the safety layer.

    `code` are paths in the package, `tests` names "FILE:FUNCTION" in the repository, `experiments` names of pages with
    measured figures, `robots` the robot models that the tests use (none: the tests use no robot model), `needs` the
    equipment without which the statement is not applicable.
    """

    statement: str
    code: tuple[str, ...]
    tests: tuple[str, ...]
    robots: tuple[str, ...]
    needs: Equipment | None = None
    experiments: tuple[str, ...] = ()


class Hazard(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A hazard, its cause, the measures of the software with their `requirements`, and the remaining hazard."""

    hazard: str
    cause: str
    measures: str
    requirements: tuple[str, ...]
    residual: str
    site: SiteMeasure | None = None


@lru_cache
def read_requirements() -> dict[str, Requirement]:
    """All requirements by id, in the order of the file."""
    return _read_packaged("requirements.toml", dict[str, Requirement])


@lru_cache
def read_hazards() -> dict[str, Hazard]:
    """All hazards by id, in the order of the file."""
    return _read_packaged("hazards.toml", dict[str, Hazard])


def required_tests() -> tuple[str, ...]:
    """Every test of a requirement once, as "FILE:FUNCTION"."""
    return tuple(dict.fromkeys(test for one in read_requirements().values() for test in one.tests))


def _read_packaged(name: str, kind: type[T]) -> T:
    return msgspec.toml.decode(
        (resources.files("dualbrain.evaluation.evidence") / "data" / name).read_bytes(), type=kind
    )
