"""The connector in the real inspect-robots, if it was fetched, and the files of its distribution and its page."""

import inspect
import os
import subprocess
import sys
import tomllib

import pytest
from inspect_robots_dualbrain import dualbrain_guarded
from inspect_robots_dualbrain.connector import BUILT_AGAINST

from dualbrain import __version__
from tests.integrations.inspect_robots.conftest import HERE, ROOT

DISTRIBUTION = ROOT / "integrations" / "inspect_robots"
PACKAGE = ROOT / "build" / "inspect_robots"
FETCH = f"make setup, or pip install --no-deps --target build/inspect_robots inspect-robots=={BUILT_AGAINST}"
TIMEOUT = 240.0


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """The variables of a process with the real inspect-robots and the connector, installed as pip installs it."""
    if not (PACKAGE / f"inspect_robots-{BUILT_AGAINST}.dist-info").is_dir():
        pytest.skip(f"inspect-robots {BUILT_AGAINST} is missing. Fetch it with `{FETCH}` (needs a package index).")
    source, folder = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("plugin")
    for file in DISTRIBUTION.rglob("*"):
        if file.suffix in (".py", ".toml", ".md") and "build" not in file.parts:
            target = source / file.relative_to(DISTRIBUTION)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(folder)]
    run([sys.executable, "-m", "pip", "install", *options, str(source)], None)
    home = tmp_path_factory.mktemp("home")
    path = os.pathsep.join([str(folder), str(PACKAGE), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path, "HOME": str(home), "DUALBRAIN_HOME": str(home)}


def run(command, variables, code=0):
    """The output of a command that has to end with `code`."""
    done = subprocess.run(
        command, env=variables, capture_output=True, text=True, check=False, timeout=TIMEOUT, cwd=ROOT
    )
    output = done.stdout + done.stderr
    assert done.returncode == code, output[-4000:]
    return output


def test_rollouts_of_inspect_robots_end_in_the_approver(environment, tmp_path):
    assert "checked" in run([sys.executable, str(HERE / "check_package.py"), str(tmp_path)], environment)


def test_the_tests_of_the_approver_pass_with_the_real_classes(environment, tmp_path):
    options = ["-q", "-p", "no:cacheprovider", f"--basetemp={tmp_path / 'tests'}"]
    output = run([sys.executable, "-m", "pytest", *options, str(HERE / "test_approver.py")], environment)
    assert "passed" in output
    assert "skipped" not in output


def test_both_programs_list_the_connector(environment):
    assert "dualbrain_guarded" in run([sys.executable, "-m", "inspect_robots.cli", "list"], environment)
    code = "import sys; from dualbrain.cli import doctor; sys.exit(doctor._print_findings(doctor._connectors()))"
    output = run([sys.executable, "-c", code], {**environment, "COLUMNS": "200"})
    assert "connector inspect_robots" in output
    assert f"built against inspect-robots {BUILT_AGAINST}, installed: {BUILT_AGAINST}" in output


def test_an_installed_connector_without_its_framework_is_reported(environment):
    folder = environment["PYTHONPATH"].split(os.pathsep)[0]
    code = "from dualbrain.core.connectors import installed_connectors as found; print(found())"
    output = run([sys.executable, "-c", code], {**environment, "PYTHONPATH": folder})
    assert "No module named 'inspect_robots'" in output


def test_the_distribution_announces_its_embodiment_and_its_connector():
    project = tomllib.loads((DISTRIBUTION / "pyproject.toml").read_text())
    (package,) = project["tool"]["setuptools"]["packages"]
    assert project["project"]["version"] == __version__
    assert project["project"]["license"] == "Apache-2.0"
    for group, entries in project["project"]["entry-points"].items():
        assert group in ("inspect_robots.embodiments", "dualbrain.integrations")
        for target in entries.values():
            module, _, name = target.partition(":")
            assert module.startswith(f"{package}.")
            assert callable(getattr(sys.modules[module], name))


def test_the_page_has_every_option_and_the_version():
    page = (ROOT / "docs" / "how-to" / "guard" / "inspect_robots.md").read_text()
    options = [name for name in inspect.signature(dualbrain_guarded).parameters if name != "inner_arguments"]
    assert [name for name in options if f"`{name}`" not in page] == []
    assert f"inspect-robots {BUILT_AGAINST}" in page
    assert page.count("\n") <= 40
