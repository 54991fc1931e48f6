"""dualbrain metrics: metrics of a running gatekeeper for Prometheus."""

from __future__ import annotations

from pathlib import Path
from threading import Event

from dualbrain.cli.common.console import print_message
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.signals import interrupt_handler
from dualbrain.core.paths import dualbrain_home
from dualbrain.core.untrusted.loopback import is_loopback
from dualbrain.errors import ConfigurationError, UsageError

DEFAULT_PORT = 9107
MAX_PORT = 65535


def metrics(
    *, socket: Path | None = None, run: Path | None = None, port: int = DEFAULT_PORT, host: str = "127.0.0.1"
) -> int:
    """Serve metrics of a running gatekeeper to Prometheus: ticks, interventions, filter, supervisor, contracts.

    Parameters
    ----------
    socket
        Path of the gatekeeper's socket. Default: gatekeeper.sock in the data folder of dualbrain.
    run
        Run folder of a `dualbrain run --live` that is running, whose gatekeeper is observed.
    port
        Port of the page /metrics; 0 chooses a free one.
    host
        Address of the page. Only addresses of this machine are accepted, because the page has no access control.
    """
    from prometheus_client import start_http_server

    from dualbrain.cli.servers.gatekeeper import run_address
    from dualbrain.runtime.inspection.gatekeeper_metrics import GatekeeperObserver, metrics_registry

    if not is_loopback(host):
        fix = "Use 127.0.0.1, and forward the port over ssh or a proxy with access control."
        raise UsageError("--host", got=host, allowed="an address of this machine, such as 127.0.0.1", fix=fix)
    if not 0 <= port <= MAX_PORT:
        raise UsageError("--port", got=port, allowed=f"0 to {MAX_PORT}")
    where = socket or (run_address(run)[0] if run is not None else dualbrain_home() / "gatekeeper.sock")
    observer = GatekeeperObserver(where, _print_problem)
    try:
        server, thread = start_http_server(port, host, metrics_registry(observer))
    except OSError as error:
        problem = f"The metrics cannot be served at {host}:{port}: {error.strerror or error}."
        raise ConfigurationError.stating(problem, fix="Name another --port.") from error
    observer.read()
    print_message(f"Metrics: http://{host}:{server.server_port}/metrics, of {where}. Ctrl-C ends them.")
    ended = Event()
    with interrupt_handler(ended.set):
        ended.wait()
    server.shutdown()
    server.server_close()
    thread.join()
    observer.close()
    return ExitCode.SUCCESS


def _print_problem(problem: str) -> None:
    print_message(f"dualbrain metrics: {problem or 'the gatekeeper answers.'}")
