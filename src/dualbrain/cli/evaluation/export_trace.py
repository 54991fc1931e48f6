"""dualbrain export trace: a finished run as an OpenTelemetry trace."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import TYPE_CHECKING

from dualbrain.cli.common.console import StderrConsole, print_message, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.spinner import Spinner
from dualbrain.errors import ConfigurationError, UsageError

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import ReadableSpan

TIMEOUT_S = 5.0
"""Time limit for sending a trace, with repetitions [s]."""
MAX_REASON_CHARACTERS = 200


def export_trace(run: Path, /, *, endpoint: str = "") -> int:
    """Write a finished run as an OpenTelemetry trace: retrieval, planner requests, checks by the gate, actions.

    Without --endpoint the spans are printed as JSON, one per line. The ids depend only on the episode, so a second
    export is the same trace. Instruction, outcome and reasons are part of the trace; prompts and answers are not.

    Example: `dualbrain export trace runs/a --endpoint http://127.0.0.1:4318/v1/traces`.

    Parameters
    ----------
    run
        Folder of a run, as `dualbrain run --out DIR` writes it.
    endpoint
        URL to which the trace is sent (OTLP over HTTP), for example that of an OpenTelemetry collector or of Jaeger.
    """
    from dualbrain.planner.backends.key_redaction import public_address
    from dualbrain.runtime.inspection.run_trace import episode_spans, read_episode_file

    if endpoint and not endpoint.startswith(("http://", "https://")):
        raise UsageError(
            "--endpoint", got=public_address(endpoint), allowed="a URL such as http://127.0.0.1:4318/v1/traces"
        )
    spans = episode_spans(read_episode_file(run))
    if not endpoint:
        for span in spans:
            print_result(span.to_json(indent=None))
        return ExitCode.SUCCESS
    with Spinner(StderrConsole(), f"sending {len(spans)} spans"):
        fault = _send(spans, endpoint)
    if fault:
        fix = "Check that a collector listens there for OTLP over HTTP."
        raise ConfigurationError.stating(f"The trace was not accepted at {public_address(endpoint)}: {fault}.", fix=fix)
    print_message(f"{len(spans)} spans sent to {public_address(endpoint)}")
    return ExitCode.SUCCESS


def _send(spans: Sequence[ReadableSpan], endpoint: str) -> str:
    """Send `spans`; "" if they were accepted, else the reason."""
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    from opentelemetry.sdk.trace.export import SpanExportResult

    log = logging.getLogger("opentelemetry.exporter")  # the exporter reports reasons only there
    reasons = BufferingHandler(capacity=1000)
    log.addHandler(reasons)
    log.propagate = False
    exporter = OTLPSpanExporter(endpoint=endpoint, timeout=TIMEOUT_S)
    try:
        sent = exporter.export(spans)
    finally:
        exporter.shutdown()
        log.removeHandler(reasons)
        log.propagate = True
    first = reasons.buffer[0].getMessage() if reasons.buffer else "no reason given"
    return "" if sent is SpanExportResult.SUCCESS else first[:MAX_REASON_CHARACTERS]
