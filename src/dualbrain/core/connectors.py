"""Connectors: distributions that put dualbrain under another framework announce themselves, for `dualbrain doctor`.

A distribution announces its connector by an entry point in its pyproject.toml:

    [project.entry-points."dualbrain.integrations"]
    my_framework = "my_package.connector:connector"     # a Connector, or a function without parameters that returns one
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.metadata import EntryPoint, entry_points

from dualbrain.errors import ConfigurationError

ENTRY_POINTS = "dualbrain.integrations"
"""Group of the entry points of connectors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Connector:
    """A connector of a framework, as its distribution announces it.

    `description` is one sentence, `version` that of the connector. `framework` is the name of the framework's
    distribution ("lerobot"), and `framework_version` the version against which the connector was built. `check`
    returns the problems of this installation as sentences, each with its remedy; none if the connector works.
    """

    name: str
    description: str
    version: str
    framework: str
    framework_version: str
    check: Callable[[], Sequence[str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectorState:
    """An installed connector: name of its entry point, distribution, description ("" if unknown), and problems."""

    name: str
    distribution: str
    text: str
    problems: tuple[str, ...]


def installed_connectors() -> tuple[ConnectorState, ...]:
    """The state of every announced connector, in the order of their names, also of those that cannot be loaded."""
    entries = sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: (entry.name, entry.value))
    return tuple(_connector_state(entry) for entry in entries)


def _connector_state(entry: EntryPoint) -> ConnectorState:
    distribution, text, problems = "unknown", "", ()
    try:
        distribution = entry.dist.name if entry.dist is not None else distribution
        connector = _load_connector(entry)
        text = _describe(connector)
        problems = _find_problems(connector)
    except (Exception, SystemExit) as error:  # any error of the other package
        cause = f"{type(error).__name__}: {error}"
        problems = (
            f"{entry.value} cannot be loaded ({cause}). Install what it needs, or `pip uninstall {distribution}`",
        )
    return ConnectorState(name=entry.name, distribution=distribution, text=text, problems=problems)


def _load_connector(entry: EntryPoint) -> Connector:
    loaded = entry.load()
    connector = loaded if isinstance(loaded, Connector) or not callable(loaded) else loaded()
    if not isinstance(connector, Connector):
        raise ConfigurationError(
            "entry point", got=type(connector).__name__, allowed="a Connector, or a function that returns one"
        )
    return connector


def _describe(connector: Connector) -> str:
    try:
        found = metadata.version(connector.framework)
    except metadata.PackageNotFoundError:
        found = "not installed"
    built = f"built against {connector.framework} {connector.framework_version}, installed: {found}"
    return f"{connector.name} {connector.version}: {connector.description} ({built})"


def _find_problems(connector: Connector) -> tuple[str, ...]:
    """The problems that the check of `connector` finds; a check that fails is one."""
    try:
        found = connector.check()
        problems = [found] if isinstance(found, str) else [str(problem) for problem in found]
    except (Exception, SystemExit) as error:  # any error of the other package
        return (f"the check of {connector.name} failed: {type(error).__name__}: {error}",)
    return tuple(problem for problem in problems if problem)
