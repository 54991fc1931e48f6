"""Bad values at every interface: one bad field in an otherwise valid input, and its declared outcome.

A number of a state that is not finite or too large stops the robot; every other bad value is refused by an error of
dualbrain, and an update that is refused leaves a filter that certifies nothing until the next valid update. A valid
input, the control, is accepted and certified.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import Any

import numpy as np

from dualbrain.errors import DualbrainError
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.interfaces.bad_values import HARMLESS, KINDS, NUMBER, VALID, make_value
from experiments.interfaces.geometry_interfaces import Field, Interface, Refusal, Testbed

CASES_PER_UNIT = 1000
UNITS = 1000
"""Units of the experiment: one million cases in all."""
NUMERIC_KINDS = ("nan", "infinite", "huge", "denormal", "negative")


@cache
def testbed() -> Testbed:
    """The filters of this process."""
    return Testbed()


@cache
def all_interfaces() -> dict[str, Interface]:
    """The interfaces of this process."""
    return testbed().interfaces()


def draw_case(rng: np.random.Generator) -> tuple[str, str, str]:
    """Name of an interface, of one of its fields, and a kind; every eighth case is the control."""
    interfaces = all_interfaces()
    name = list(interfaces)[int(rng.integers(len(interfaces)))]
    fields = list(interfaces[name].fields)
    kind = VALID if rng.random() < 0.125 else KINDS[int(rng.integers(len(KINDS)))]
    return name, fields[int(rng.integers(len(fields)))], kind


def run_case(name: str, field: str, kind: str, rng: np.random.Generator) -> str:
    """The problem with the outcome of one case, or ""."""
    interface = all_interfaces()[name]
    given = {key: one.valid for key, one in interface.fields.items()}
    tested = interface.fields[field]
    given[field] = make_value(kind, tested.form, tested.valid, rng)
    if tested.optional and given[field] is None:
        return ""
    try:
        certified = interface.call(given)
    except (DualbrainError, Refusal) as error:
        problem = _check_refusal(interface, tested, kind, error)
    except Exception as error:
        problem = f"raised {type(error).__name__}: {str(error)[:200]}"
    else:
        problem = _check_answer(interface, tested, kind, certified)
    testbed().restore()
    return problem


def _check_refusal(interface: Interface, field: Field, kind: str, error: Exception) -> str:
    """A refusal is right for every bad value; afterwards the filter certifies nothing."""
    if kind == VALID:
        return f"refused a valid value: {str(error)[:200]}"
    if interface.step and kind in NUMERIC_KINDS and field.form != NUMBER:
        return f"raised for a number of the state, instead of a stop: {str(error)[:200]}"
    if interface.certifies is not None and interface.certifies():
        return "certified a step after a refused update"
    return ""


def _check_answer(interface: Interface, field: Field, kind: str, certified: bool) -> str:
    """An answer is right for a valid or harmless value, and a stop for a bad number of a state."""
    if kind == VALID:
        return "" if certified else "did not certify a valid value"
    if kind in HARMLESS[field.form] or (interface.step and not certified):
        return ""
    return "accepted a bad value"


class BadInput:
    """One million bad values at every interface that takes geometric input."""

    name = "bad_input"
    claim = "Every bad value is refused or stops the robot, and no step is certified after a refused update."

    def units(self, options: Options) -> list[WorkUnit]:
        """Units of 1000 cases with their own seeds."""
        del options
        return [WorkUnit(f"seed {seed}", {"seed": seed, "cases": CASES_PER_UNIT}) for seed in range(UNITS)]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the cases of one seed; the row counts them by kind and lists the wrong outcomes."""
        rng, counts = np.random.default_rng(parameters["seed"]), Counter[str]()
        problems: list[str] = []
        for _ in range(parameters["cases"]):
            name, field, kind = draw_case(rng)
            counts[kind] += 1
            if problem := run_case(name, field, kind, rng):
                problems.append(f"{name}, {field}, {kind}: {problem}")
        return {"cases": sum(counts.values()), "kinds": dict(counts), "problems": problems}

    def summarize_row(self, row: Row) -> str:
        """The number of cases and of wrong outcomes."""
        return f"{row['cases']} cases, {len(row['problems'])} wrong"

    def report(self, rows: list[Row]) -> list[str]:
        """Cases and wrong outcomes by kind."""
        done = [row for row in rows if "problems" in row]
        total = Counter[str]()
        for row in done:
            total.update(row["kinds"])
        problems = [problem for row in done for problem in row["problems"]]
        cells = [[kind, str(total[kind])] for kind in (*KINDS, VALID)]
        lines = markdown_table(["kind of value", "cases"], [*cells, ["all", str(sum(total.values()))]])
        return [*lines, "", f"{len(problems)} wrong outcomes.", *(f"- {problem}" for problem in problems[:20])]
