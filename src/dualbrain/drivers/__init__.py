"""Drivers of real arms behind the robot interface, fakes of their vendor libraries, and a conformance test."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.drivers.catalogue import DriverKind, find_driver_kind
    from dualbrain.drivers.conformance.harness import DriverUnderTest
    from dualbrain.drivers.conformance.rules import Requirement, RequirementResult, RequirementStatus
    from dualbrain.drivers.driver import Driver

_MODULES = {
    "drivers.catalogue": (
        "DriverKind",
        "find_driver_kind",
    ),
    "drivers.conformance.harness": ("DriverUnderTest",),
    "drivers.conformance.rules": (
        "Requirement",
        "RequirementResult",
        "RequirementStatus",
    ),
    "drivers.driver": ("Driver",),
}
"""Public names by the module that defines them."""

__all__ = [
    "Driver",
    "DriverKind",
    "DriverUnderTest",
    "Requirement",
    "RequirementResult",
    "RequirementStatus",
    "find_driver_kind",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
