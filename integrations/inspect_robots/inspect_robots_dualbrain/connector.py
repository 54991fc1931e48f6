"""The announcement of this connector for `dualbrain doctor`, with the parts of inspect-robots that it needs."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import fields
from importlib.metadata import version

from inspect_robots import approver, errors, registry, spaces, types

from dualbrain import Connector

BUILT_AGAINST = "0.60.0"
RECORD_FIELDS = {
    types.Action: ("data", "meta"),
    types.Observation: ("state", "state_time", "extra"),
    types.StepResult: ("observation", "info"),
    spaces.ActionSemantics: ("control_mode", "dim_labels"),
    spaces.Box: ("shape", "semantics"),
    spaces.StateField: ("key", "shape", "unit"),
    approver.GuardrailContribution: ("approvers", "warnings"),
}
"""The fields of records of inspect-robots that the connector uses."""
EMBODIMENT = "dualbrain_guarded"


def find_api_problems() -> Iterator[str]:
    """The differences between the installed inspect-robots and the one that the connector was built against."""
    for record, names in RECORD_FIELDS.items():
        missing = sorted(set(names) - {field.name for field in fields(record)})
        if missing:
            yield f"{record.__name__} of inspect-robots has no {', '.join(missing)}"
    parameters = list(inspect.signature(approver.Approver.review).parameters)
    if parameters != ["self", "action", "store"]:
        yield f"Approver.review of inspect-robots has the parameters {', '.join(parameters)}"
    if not callable(getattr(approver.DeltaLimitApprover, "rewind_reference", None)):
        yield "DeltaLimitApprover of inspect-robots has no rewind_reference"
    if not issubclass(errors.SafetyAbort, errors.InspectRobotsError):
        yield "SafetyAbort of inspect-robots is no error that halts an evaluation"


def check() -> list[str]:
    """The problems of this installation."""
    problems = [f"{text}. Use inspect-robots {BUILT_AGAINST}." for text in find_api_problems()]
    if EMBODIMENT not in registry.registered("embodiment"):
        problems.append(f"inspect-robots does not find the embodiment {EMBODIMENT}. Install the connector again.")
    return problems


def connector() -> Connector:
    """The connector of inspect-robots."""
    return Connector(
        name="inspect-robots",
        description=f"embodiment {EMBODIMENT} with an approver that states which limit changed an action",
        version=version("inspect_robots_dualbrain"),
        framework="inspect-robots",
        framework_version=BUILT_AGAINST,
        check=check,
    )
