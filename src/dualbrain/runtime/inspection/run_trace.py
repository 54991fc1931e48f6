"""A finished run as an OpenTelemetry trace, read from `episode.json`; nothing is added to the control loop.

One root span `episode` contains retrieval, each request to the planner with its check by the gate, and each action.
Attributes of requests are those of the semantic conventions for generative AI (`gen_ai.*`); all others begin with
`dualbrain.`. Planning has wall time and motion has the time of the robot's clock, so the actions follow the decision.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import msgspec
from opentelemetry import trace
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.sdk.trace.id_generator import IdGenerator

import dualbrain
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError
from dualbrain.records import Attempt, Episode

EPISODE_FILE = "episode.json"
MAX_EPISODE_BYTES = 64 << 20
"""Largest size of an episode.json [bytes]."""
NS_PER_S = 1e9

AttributeValue = str | int | float | Sequence[str]
Attributes = dict[str, AttributeValue]
TimedSpan = tuple[str, float, float, Attributes]
"""Name, begin and end [s since the start of the episode] and attributes of a span."""


class EpisodeIds(IdGenerator):
    """Ids from a hash of the episode, so that a repeated export overwrites the trace instead of adding another."""

    def __init__(self, episode: Episode) -> None:
        """Derive the ids from the id and the start of `episode`."""
        self._seed, self._count = f"{episode.id} {episode.started}", 0

    def generate_trace_id(self) -> int:
        """16 bytes, not zero."""
        return self._number("trace", 16)

    def generate_span_id(self) -> int:
        """8 bytes, not zero; another one at each call."""
        self._count += 1
        return self._number(f"span {self._count}", 8)

    def _number(self, name: str, size: int) -> int:
        digest = hashlib.sha256(f"{self._seed} {name}".encode()).digest()
        return int.from_bytes(digest[:size], "big") or 1


def read_episode_file(run: Path) -> Episode:
    """The episode of the run folder `run`.

    Raises `MissingDependencyError` if the folder contains none, and `ConfigurationError` if it cannot be read.
    """
    path = run / EPISODE_FILE
    if not path.is_file():
        fix = "Name the folder of a finished run (`dualbrain run --out DIR`)."
        raise MissingDependencyError(f"The episode of a run, {path},", fix=fix)
    try:
        return msgspec.json.decode(read_bounded_file(path, MAX_EPISODE_BYTES), type=Episode)
    except DECODE_ERRORS as error:
        fix = f"Restore a copy, or name another run. {path}"
        raise ConfigurationError.stating(f"The episode of the run is damaged: {error}.", fix=fix) from error


def episode_spans(episode: Episode) -> tuple[ReadableSpan, ...]:
    """The spans of `episode` in the order of their ends; the root comes last."""
    collected = InMemorySpanExporter()
    resource = Resource.create({"service.name": "dualbrain", "service.version": dualbrain.__version__})
    provider = TracerProvider(resource=resource, id_generator=EpisodeIds(episode), shutdown_on_exit=False)
    provider.add_span_processor(SimpleSpanProcessor(collected))
    tracer = provider.get_tracer("dualbrain", dualbrain.__version__)
    start = datetime.fromisoformat(episode.started).timestamp()
    root = tracer.start_span("episode", start_time=_nanoseconds(start), attributes=_episode_attributes(episode))
    context, last = trace.set_span_in_context(root), 0.0
    for name, begin, end, attributes in _timed_spans(episode):
        span = tracer.start_span(name, context, start_time=_nanoseconds(start + begin), attributes=attributes)
        span.end(_nanoseconds(start + end))
        last = max(last, end)
    root.end(_nanoseconds(start + last))
    provider.shutdown()
    return collected.get_finished_spans()


def _timed_spans(episode: Episode) -> Iterator[TimedSpan]:
    """Retrieval, requests with their checks, actions."""
    at = episode.timings.get("retrieval", 0.0)
    recalled = episode.recall.exemplars
    yield "retrieve", 0.0, at, {"dualbrain.memories": len(recalled)}
    for attempt in episode.attempts:
        asked = at + attempt.proposal.timings.get("total", 0.0)
        yield f"chat {attempt.proposal.planner}", at, asked, _request_attributes(attempt)
        at = asked + attempt.gate_s
        yield "gate", asked, at, _verdict_attributes(attempt)
    actions = episode.outcome.actions
    offset = at - actions[0].started if actions else 0.0
    for action in actions:
        found = {"status": action.status, "reason": action.reason, "delta": action.Delta, "cause": action.cause}
        yield f"action {action.skill}", offset + action.started, offset + action.ended, _own(found)


def _episode_attributes(episode: Episode) -> Attributes:
    outcome, judgement = episode.outcome, episode.judgement
    found = {
        "episode": episode.id,
        "instruction": episode.instruction,
        "robot": episode.robot,
        "registry": episode.registry,
        "outcome": outcome.kind,
        "reason": outcome.reason,
        "delta": outcome.Delta,
        "delta_peak": outcome.delta_peak,
        "h_min": outcome.h_min,
        "second_opinion": episode.second_opinion,
        "violations": None if judgement is None else len(judgement.violations),
    }
    return _own(found)


def _request_attributes(attempt: Attempt) -> Attributes:
    proposal = attempt.proposal
    found: Attributes = {
        "gen_ai.operation.name": "chat",
        "gen_ai.request.model": proposal.planner,
        "gen_ai.response.finish_reasons": [proposal.finish_reason],
    }
    for key, name in (("prompt_tokens", "input_tokens"), ("output_tokens", "output_tokens")):
        if key in proposal.timings:
            found[f"gen_ai.usage.{name}"] = int(proposal.timings[key])
    return found


def _verdict_attributes(attempt: Attempt) -> Attributes:
    verdict = msgspec.to_builtins(attempt.verdict)
    return _own({"verdict": verdict["verdict"], "stage": verdict.get("stage"), "pointer": verdict.get("pointer")})


def _own(values: dict[str, str | int | float | None]) -> Attributes:
    """The attributes of dualbrain, without those that have no value."""
    return {f"dualbrain.{name}": value for name, value in values.items() if value is not None}


def _nanoseconds(seconds: float) -> int:
    """Time since 1970 UTC [s] in nanoseconds."""
    return round(seconds * NS_PER_S)
