"""Units are coherent SI units in one spelling; any other unit is an error when the registry is built."""

import subprocess
import sys

import pint
import pytest

from dualbrain.core.units import SI_SYMBOLS, require_si
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


def test_the_error_names_the_symbol_and_the_symbols_to_use() -> None:
    with pytest.raises(ConfigurationError, match=r"'mm' is not one of .*\bm, mol"):
        require_si("N/mm")


def test_every_symbol_is_the_short_name_of_a_unit_with_the_factor_1_according_to_pint() -> None:
    registry = pint.UnitRegistry()
    for symbol in SI_SYMBOLS:
        assert format(registry.parse_units(symbol), "~C") == symbol
        assert registry.Quantity(1.0, registry.parse_units(symbol)).to_base_units().magnitude == 1.0


def test_contracts_import_without_plant_or_torch() -> None:
    code = (
        "import pkgutil, sys, importlib, dualbrain.contracts as package\n"
        "for part in pkgutil.iter_modules(package.__path__):"
        " importlib.import_module(f'dualbrain.contracts.{part.name}')\n"
        "print(sorted({'mujoco', 'torch', 'transformers', 'jsonschema', 'numpy'} & set(sys.modules)))"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "[]"
