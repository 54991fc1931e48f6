"""Units are coherent SI units in one spelling; any other unit is an error when the registry is built."""

import subprocess
import sys

import pytest

from dualbrain.core.units import require_si
from dualbrain.errors import ConfigurationError


@pytest.mark.parametrize("unit", ["1", "m", "m/s", "m/s**2", "N", "N*m", "N/m", "rad", "rad/s", "s", "kg", "1/s", "K"])
def test_si_units_pass_unchanged(unit: str) -> None:
    assert require_si(unit) == unit


@pytest.mark.parametrize(
    "unit",
    [
        "mm",
        "cm",
        "km/h",
        "deg",
        "deg/s",
        "rpm",
        "g",
        "min",
        "%",
        "degC",
        "ft",
        "kN",
        "ms",  # not coherent
        "",
        " m",
        "m/s ",
        "metre",
        "m/s^2",
        "m s",
        "2*m",
        "m/",
        "/s",
        "m**9",
        "(m)",  # another spelling
        "foo",
        "xyz/s",
        "__import__('os')",
        "m" * 500,
        "µm",
        "µ",
    ],
)
def test_any_other_unit_is_refused(unit: str) -> None:
    with pytest.raises(ConfigurationError, match="unit"):
        require_si(unit)


def test_the_error_states_the_conversion_factor() -> None:
    with pytest.raises(ConfigurationError, match=r"One mm is 0\.001 in base units"):
        require_si("mm")


def test_contracts_import_without_pint_plant_or_torch() -> None:
    code = (
        "import pkgutil, sys, importlib, dualbrain.contracts as package\n"
        "for part in pkgutil.iter_modules(package.__path__):"
        " importlib.import_module(f'dualbrain.contracts.{part.name}')\n"
        "print(sorted({'pint', 'mujoco', 'torch', 'transformers', 'jsonschema', 'numpy'} & set(sys.modules)))"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "[]"
