"""Metrics of a running gatekeeper for Prometheus, from an observer without a key on the gatekeeper's socket.

The gatekeeper counts every tick itself; each scrape asks for the counts once. Names and label values are those of
`METRICS`, so that nothing that arrives on the socket can create one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import accumulate
from pathlib import Path
from threading import Lock
from typing import Literal

import msgspec
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import StatusReport
from dualbrain.control.gatekeeper.timing.tick_counts import (
    CLEARANCE_BOUNDS,
    CONSTRAINT_KINDS,
    DELTA_BOUNDS,
    OUTCOMES,
    VERDICTS,
    TickCounts,
)
from dualbrain.errors import DualbrainError
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.supervisor.actions import SafetyAction

REPLY_TIMEOUT_S = 1.0
"""Longest wait for the counts [s]."""
NOT_SUPPORTED = "is not known"
"""End of the reason for which a gatekeeper without counts refuses the request."""


class Reading(msgspec.Struct, frozen=True):
    """One reading of a gatekeeper: its counts, and its newest status, None until the first one has arrived."""

    counts: TickCounts
    status: StatusReport | None


class MetricSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One metric: its name without `dualbrain_`, kind, description, and the values of its `label`, if it has one.

    `read` returns its value, the value for each label value, or the counts of the bins of a histogram; nothing if the
    reading has none. `bounds` are the upper bounds of the bins, and `read_sum` returns the sum of the binned values.
    """

    name: str
    description: str
    read: Callable[[Reading], tuple[float, ...]]
    read_sum: Callable[[Reading], float] = lambda one: 0.0
    kind: Literal["counter", "gauge", "histogram"] = "counter"
    label: str = ""
    values: tuple[str, ...] = ()
    bounds: tuple[float, ...] = ()

    @property
    def full_name(self) -> str:
        """The name on the page; counters end with `_total`."""
        return f"dualbrain_{self.name}{'_total' if self.kind == 'counter' else ''}"


def _names(codes: type[FilterStatus] | type[SafetyAction]) -> tuple[str, ...]:
    return tuple(code.name.lower() for code in codes)


def _severity(reading: Reading) -> tuple[float, ...]:
    """The number of the supervisor's action; nothing without a status, or for an action that is not known."""
    action = SafetyAction.__members__.get(reading.status.action) if reading.status else None
    return () if action is None else (action,)


METRICS = (
    MetricSpec(name="ticks", description="control ticks", read=lambda one: (one.counts.ticks,)),
    MetricSpec(
        name="contract_ticks", description="control ticks of contracts", read=lambda one: (one.counts.contract_ticks,)
    ),
    MetricSpec(
        name="interventions",
        description="ticks in which the control was changed: δ above 0.0001",
        read=lambda one: (one.counts.interventions,),
    ),
    MetricSpec(name="late_ticks", description="ticks that took too long", read=lambda one: (one.counts.late,)),
    MetricSpec(
        name="missed_states", description="joint states that never arrived", read=lambda one: (one.counts.missed,)
    ),
    MetricSpec(
        name="filter_ticks",
        description="ticks by status of the safety filter",
        read=lambda one: one.counts.filter_status,
        label="status",
        values=_names(FilterStatus),
    ),
    MetricSpec(
        name="supervisor_ticks",
        description="ticks by action of the supervisor",
        read=lambda one: one.counts.actions,
        label="action",
        values=_names(SafetyAction),
    ),
    MetricSpec(
        name="binding_ticks",
        description="ticks in which a constraint of this kind was binding",
        read=lambda one: one.counts.binding,
        label="constraint",
        values=CONSTRAINT_KINDS,
    ),
    MetricSpec(
        name="contracts",
        description="proposed contracts by verdict",
        read=lambda one: one.counts.verdicts,
        label="verdict",
        values=VERDICTS,
    ),
    MetricSpec(
        name="outcomes",
        description="executed contracts by outcome",
        read=lambda one: one.counts.outcomes,
        label="outcome",
        values=OUTCOMES,
    ),
    MetricSpec(
        name="delta",
        description="intervention δ of every tick, as a fraction of full speed",
        read=lambda one: one.counts.delta,
        read_sum=lambda one: one.counts.delta_sum,
        kind="histogram",
        bounds=DELTA_BOUNDS,
    ),
    MetricSpec(
        name="clearance_metres",
        description="smallest barrier value h of every tick [m]; below zero a margin is violated",
        read=lambda one: one.counts.clearance,
        read_sum=lambda one: one.counts.clearance_sum,
        kind="histogram",
        bounds=CLEARANCE_BOUNDS,
    ),
    MetricSpec(
        name="clearance_now_metres",
        description="smallest barrier value h of the newest tick [m]",
        read=lambda one: () if one.counts.h_min is None else (one.counts.h_min,),
        kind="gauge",
    ),
    MetricSpec(
        name="severity",
        description="action of the supervisor: 0 none, 1 warn, 2 slow, 3 hover, 4 hold, 5 controlled stop, "
        "6 emergency stop, 7 lockout",
        read=_severity,
        kind="gauge",
    ),
    MetricSpec(
        name="busy",
        description="1 while a contract runs or is checked in order to run",
        read=lambda one: (one.status.busy,) if one.status else (),
        kind="gauge",
    ),
    MetricSpec(
        name="commander_connected",
        description="1 while a commander is connected",
        read=lambda one: (one.status.commander,) if one.status else (),
        kind="gauge",
    ),
)
"""All metrics but `dualbrain_up`, which is 1 if the gatekeeper answered the scrape, and 0 if it did not."""
UP_NAME, UP_DESCRIPTION = "dualbrain_up", "1 if the gatekeeper answered this scrape, else 0"


class GatekeeperObserver:
    """Reads the counts of the gatekeeper at a socket; connects again after a restart of the gatekeeper."""

    def __init__(self, socket: Path, report: Callable[[str], None] = lambda problem: None) -> None:
        """`report` gets the reason when the gatekeeper stops answering, and "" when it answers (again)."""
        self._socket, self._report = socket, report
        self._client: GatekeeperClient | None = None
        self._lock = Lock()
        self._problem: str | None = None
        self._without_counts: tuple[int, int] | None = None

    def read(self) -> Reading | None:
        """A reading, or None if the gatekeeper does not answer. Several threads may call this; it never raises."""
        with self._lock:
            try:
                reading, problem = self._read(), ""
            except (DualbrainError, OSError, ValueError) as error:  # ValueError: a path with a null character
                reading, problem = None, str(error)
                self._note_missing_support(problem)
                self._disconnect()
            if problem != self._problem:
                self._problem = problem
                self._report(problem)
            return reading

    def close(self) -> None:
        """Close the connection."""
        with self._lock:
            self._disconnect()

    def _read(self) -> Reading:
        if self._client is None or self._client.disconnected.is_set():
            self._disconnect()
            if self._without_counts is not None and self._without_counts == _socket_identity(self._socket):
                raise ConnectionLostError(self._problem or NOT_SUPPORTED)
            self._client = GatekeeperClient(self._socket)
        return Reading(self._client.request_counts(REPLY_TIMEOUT_S), self._client.status)

    def _note_missing_support(self, problem: str) -> None:
        """Never ask a gatekeeper of an older version again: each request that it refuses is a warning in its log."""
        if problem.endswith(NOT_SUPPORTED):
            self._without_counts = _socket_identity(self._socket)

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


class GatekeeperCollector(Collector):
    """The metrics of one gatekeeper; every scrape is one reading."""

    def __init__(self, read: Callable[[], Reading | None]) -> None:
        """`read` returns a reading, or None if the gatekeeper does not answer."""
        self._read = read

    def collect(self) -> Iterator[Metric]:
        """All metrics of a reading; only `dualbrain_up` without one."""
        reading = self._read()
        yield GaugeMetricFamily(UP_NAME, UP_DESCRIPTION, value=float(reading is not None))
        if reading is not None:
            for spec in METRICS:
                if values := spec.read(reading):
                    yield _family(spec, values, spec.read_sum(reading))


def metrics_registry(observer: GatekeeperObserver) -> CollectorRegistry:
    """A registry with the metrics of the gatekeeper that `observer` reads."""
    registry = CollectorRegistry()
    registry.register(GatekeeperCollector(observer.read))
    return registry


def _family(spec: MetricSpec, values: tuple[float, ...], total: float) -> Metric:
    """The samples of one metric, as the client library wants them."""
    name = f"dualbrain_{spec.name}"
    if spec.kind == "histogram":
        bounds = [*map(str, spec.bounds), "+Inf"]
        buckets = list(zip(bounds, accumulate(values), strict=True))
        return HistogramMetricFamily(name, spec.description, buckets=buckets, sum_value=total)
    kind = GaugeMetricFamily if spec.kind == "gauge" else CounterMetricFamily
    if not spec.label:
        return kind(name, spec.description, value=float(values[0]))
    family = kind(name, spec.description, labels=[spec.label])
    for label, value in zip(spec.values, values, strict=True):
        family.add_metric([label], float(value))
    return family


def _socket_identity(path: Path) -> tuple[int, int]:
    """Inode and time of change of the socket: another gatekeeper at the same path has another one."""
    found = path.lstat()
    return found.st_ino, found.st_ctime_ns
