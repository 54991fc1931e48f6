"""Connection to a Ray cluster with token authentication, and the checks of its nodes.

Any process that reaches the ports of a cluster without authentication can run code on all its nodes, so such a cluster
is refused. A node must have the code and the versions of this machine, or its episodes could differ.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import msgspec
import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.runner.provenance import collect_provenance

MODE_VARIABLE, ADDRESS_VARIABLE = "RAY_AUTH_MODE", "RAY_ADDRESS"
TOKEN_VARIABLE, TOKEN_FILE_VARIABLE = "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"
SET_UP_HINT = (
    f"Export {MODE_VARIABLE}=token on every node before `ray start`, and here. Make the token once with "
    "`ray get-auth-token --generate`, and copy ~/.ray/auth_token (mode 0600) to every node."
)
CHECK_TIMEOUT_S = 120.0
"""Longest time for the check of a node [s]; it starts Python and imports dualbrain."""


class NodeFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts of a node: its mode of authentication, its code and versions, and whether it sees the results folder."""

    authentication: str
    provenance: dict[str, str]
    sees_results: bool


def require_token(environ: Mapping[str, str], home: Path) -> None:
    """Raise `ConfigurationError` unless token authentication is on and this process has a private token.

    The token is in a variable, in the file that a variable names, or in .ray/auth_token of `home`.
    """
    if (mode := environ.get(MODE_VARIABLE, "")) != "token":
        problem = f"A Ray cluster needs token authentication: {MODE_VARIABLE} is {mode[:20]!r}."
        raise ConfigurationError.stating(problem, fix=SET_UP_HINT)
    if environ.get(TOKEN_VARIABLE):
        return
    path = Path(environ.get(TOKEN_FILE_VARIABLE) or home / ".ray" / "auth_token")
    try:
        found = path.stat()
    except OSError as error:
        problem = f"There is no token of the Ray cluster at {path}: {error.strerror}."
        raise ConfigurationError.stating(problem, fix=SET_UP_HINT) from error
    if stat.S_IMODE(found.st_mode) & 0o077:
        problem = f"Other users can read the token of the Ray cluster at {path}."
        raise ConfigurationError.stating(problem, fix=f"chmod 600 {path}")


@contextmanager
def connected(environ: Mapping[str, str], home: Path) -> Iterator[int]:
    """A connection to the running cluster while the body runs; yields its number of CPUs.

    The cluster is that of RAY_ADDRESS in `environ`, or the one that this machine is a node of. None is started. Raises
    `ConfigurationError` without token authentication, and if there is no cluster.
    """
    require_token(environ, home)
    address = environ.get(ADDRESS_VARIABLE) or "auto"
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False)
    except (ConnectionError, RayError, ValueError, RuntimeError) as error:
        problem = f"No Ray cluster can be reached at {address}: {str(error).splitlines()[0]}."
        fix = f"Start one with `ray start --head`, and name another machine's with {ADDRESS_VARIABLE}=HOST:6379."
        raise ConfigurationError.stating(problem, fix=fix) from error
    try:
        yield int(ray.cluster_resources().get("CPU", 0))
    finally:
        ray.shutdown()


def check_nodes(results_file: Path) -> None:
    """Raise `ConfigurationError` unless every node has a token, the code of this machine, and sees `results_file`."""
    here = collect_provenance()
    nodes = {node["NodeID"]: node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
    tasks = {
        node: _read_facts.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(
            str(results_file)
        )
        for node in nodes
    }
    for node, task in tasks.items():
        try:
            facts = ray.get(task, timeout=CHECK_TIMEOUT_S)
        except RayError as error:
            reason = str(error).strip().splitlines()[-1]
            fix = "Install the same dualbrain in the Python of its `ray start`."
            raise ConfigurationError.stating(
                f"The Ray node {nodes[node]} cannot run dualbrain: {reason}.", fix=fix
            ) from error
        require_equal_node(nodes[node], facts, here, results_file)


def require_equal_node(address: str, facts: NodeFacts, here: dict[str, str], results_file: Path) -> None:
    """Raise `ConfigurationError` for a node whose rows could differ, or to which other processes have access."""
    if facts.authentication != "token":
        problem = f"The Ray node {address} was started without token authentication."
        raise ConfigurationError.stating(problem, fix=f"Stop it with `ray stop`. {SET_UP_HINT}")
    differing = [name for name in here if facts.provenance.get(name) != here[name]]
    if differing:
        words = ", ".join(f"{name} {facts.provenance.get(name)} instead of {here[name]}" for name in differing)
        fix = "Install the same versions, and restart its `ray start`."
        raise ConfigurationError.stating(f"The Ray node {address} has {words}.", fix=fix)
    if not facts.sees_results:
        problem = f"The Ray node {address} does not see the results folder {results_file.parent}."
        raise ConfigurationError.stating(problem, fix="Name an --out on a file system that all nodes share.")


def read_facts(results_file: str) -> NodeFacts:
    """The facts of the node on which this runs."""
    return NodeFacts(
        authentication=os.environ.get(MODE_VARIABLE, ""),
        provenance=collect_provenance(),
        sees_results=Path(results_file).is_file(),
    )


_read_facts = ray.remote(num_cpus=0)(read_facts)
