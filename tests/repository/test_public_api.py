"""The public API: every name is importable and documented, importing is light, documents use nothing else."""

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import dualbrain
from dualbrain.errors import MissingDependencyError

ROOT = Path(__file__).resolve().parents[2]
SUB_NAMESPACES = (
    "dualbrain.safety",
    "dualbrain.safety.barriers",
    "dualbrain.safety.control_affine",
    "dualbrain.safety.higher_order",
    "dualbrain.skills",
    "dualbrain.memory",
    "dualbrain.evaluation",
    "dualbrain.drivers",
    "dualbrain.control",
    "dualbrain.simulation.environments",
)
NAMESPACES = ("dualbrain", *SUB_NAMESPACES)
SOURCES = [*sorted((ROOT / "examples").rglob("*.py")), ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
DEVELOPER_PAGES = (
    "docs/reference/migration.md",
    "docs/results/",
    "docs/experiments/",
    "docs/decisions/",
)
"""Pages about the inside of the package, which name private modules."""


def fresh(code):
    """What a fresh interpreter prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_name_is_importable(namespace):
    module = importlib.import_module(namespace)
    assert len(module.__all__) == len(set(module.__all__))
    for name in module.__all__:
        assert getattr(module, name) is not None
    assert set(module.__all__) <= set(dir(module))


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_class_and_function_is_documented(namespace):
    module = importlib.import_module(namespace)
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), name


def test_unknown_names_raise_as_in_any_module():
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = dualbrain.Nothing


def test_importing_the_package_takes_less_than_100_ms_and_no_numpy():
    code = (
        "import sys, time; begun = time.process_time(); import dualbrain; "
        "import json; print(json.dumps([time.process_time() - begun, 'numpy' in sys.modules]))"
    )
    times, numpy = zip(*(json.loads(fresh(code)) for _ in range(3)), strict=True)
    assert min(times) < 0.1
    assert not any(numpy)


def test_a_missing_package_is_reported_with_the_install_command():
    code = (
        "import sys; sys.modules['mujoco'] = None; import dualbrain\n"
        "try: dualbrain.SimulatedCell\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    assert fresh(code).startswith(MissingDependencyError.__name__)
    assert "pip install 'dualbrain[simulation]'" in fresh(code)


def imported_modules(source):
    """Modules of dualbrain that a Python source imports from, with the names."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dualbrain"):
            yield node.module, [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("dualbrain"):
                    yield alias.name, []


def programs(path):
    """The Python programs in a file."""
    text = path.read_text("utf-8")
    return [text] if path.suffix == ".py" else re.findall(r"```python[^\n]*\n(.*?)```", text, re.DOTALL)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_readme_docs_and_examples_import_only_the_public_api(path):
    relative = str(path.relative_to(ROOT))
    if relative.startswith(DEVELOPER_PAGES):
        return
    for program in programs(path):
        for module, names in imported_modules(program):
            assert module in NAMESPACES, f"{module} is private"
            public = importlib.import_module(module).__all__
            assert set(names) <= set(public), f"{module} does not export {set(names) - set(public)}"
