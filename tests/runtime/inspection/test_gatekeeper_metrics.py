"""Metrics of a gatekeeper: the page parses, names and labels are closed, and no gatekeeper can stop the observer."""

import os
import re
import socket
from pathlib import Path
from threading import Thread

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    CountsReport,
    RequestRefused,
    StatusReport,
    Welcome,
    encode_body,
    kind_code,
)
from dualbrain.control.gatekeeper.timing.tick_counts import LENGTHS, TickCounter
from dualbrain.runtime.inspection import gatekeeper_metrics
from dualbrain.runtime.inspection.gatekeeper_metrics import (
    METRICS,
    UP_DESCRIPTION,
    UP_NAME,
    GatekeeperCollector,
    GatekeeperObserver,
    Reading,
    metrics_registry,
)
from tests.control.gatekeeper.lockstep_cell import lockstep_cell

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "safety" / "metrics.md").read_text("utf-8")
COUNTS = TickCounter().counts(0, 0)
SIZES = st.integers(0, 1 << 50)
COUNT_VALUES = st.fixed_dictionaries({name: st.tuples(*[SIZES] * length) for name, length in LENGTHS.items()})


def status(action="NONE"):
    return StatusReport(now=0.0, action=action, cause="", check="", busy=True, commander=False)


def page_of(reading):
    return generate_latest(GatekeeperCollector(lambda: reading)).decode()


def samples_of(page):
    """Value of every sample on a page, by its name and labels."""
    families = text_string_to_metric_families(page)
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value for family in families for sample in family.samples
    }


def scrape(observer):
    return samples_of(generate_latest(metrics_registry(observer)).decode())


class FakeGatekeeper:
    """Accepts observers at `path` and answers their first request with `reply`, raw bytes of a body or a message."""

    def __init__(self, path, reply):
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._reply, self.requests = reply, 0
        Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                for number, message in enumerate(
                    (Challenge(b"n" * 16), Welcome(role="observer", now=0.0, robot="{evil}", registry="")), start=1
                ):
                    connection.sendall(encode(kind_code(message), number, encode_body(message)))
                    connection.recv(4096)
                self.requests += 1
                connection.sendall(self._reply(3))

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()


def as_message(message):
    return lambda number: encode(kind_code(message), number, encode_body(message))


@given(COUNT_VALUES, st.floats(allow_nan=False), st.sampled_from(("HOLD", "NONE")))
def test_the_page_states_every_count(values, h_min, action):
    counts = msgspec.structs.replace(COUNTS, **values, ticks=7, h_min=h_min)
    reading = Reading(counts, status(action))
    samples = samples_of(page_of(reading))
    for spec in METRICS:
        found = spec.read(reading)
        if spec.kind == "histogram":
            bins = [samples[f"{spec.full_name}_bucket", ("le", str(bound))] for bound in (*spec.bounds, "+Inf")]
            assert bins == pytest.approx([sum(found[: k + 1]) for k in range(len(found))])
            assert samples[f"{spec.full_name}_count",] == bins[-1]
            continue
        labels = [((spec.label, value),) for value in spec.values] if spec.label else [()]
        assert [samples[spec.full_name, *label] for label in labels] == pytest.approx([float(one) for one in found])
    assert samples["dualbrain_ticks_total",] == 7
    assert samples["dualbrain_severity",] == {"HOLD": 4, "NONE": 0}[action]


@given(st.text(), st.text())
def test_no_text_of_a_message_is_on_the_page(action, cause):
    known = page_of(Reading(COUNTS, status("NONE")))
    page = page_of(Reading(COUNTS, msgspec.structs.replace(status(action), cause=cause, check=cause)))
    without = [line for line in known.splitlines() if "severity" not in line]
    assert [line for line in page.splitlines() if "severity" not in line] == without


def test_only_up_is_on_the_page_of_a_gatekeeper_that_does_not_answer():
    assert samples_of(page_of(None)) == {("dualbrain_up",): 0.0}


def test_the_documentation_lists_every_metric_with_its_labels():
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| (.*?) \| (.*?) \|$", PAGE, re.MULTILINE)
    expected = [(UP_NAME, "gauge", "", UP_DESCRIPTION)] + [
        (one.full_name, one.kind, f"`{one.label}`: {', '.join(one.values)}" if one.label else "", one.description)
        for one in METRICS
    ]
    assert rows == expected


def test_an_observer_follows_a_gatekeeper_across_restarts(tmp_path):
    path, problems = tmp_path / "s", []
    observer = GatekeeperObserver(path, problems.append)
    assert scrape(observer) == {("dualbrain_up",): 0.0}
    for _ in range(2):
        with lockstep_cell(tmp_path):
            first, second = scrape(observer), scrape(observer)
            assert (first["dualbrain_up",], second["dualbrain_up",]) == (1.0, 1.0)
            assert 0 <= first["dualbrain_ticks_total",] <= second["dualbrain_ticks_total",]
    assert scrape(observer) == {("dualbrain_up",): 0.0}
    observer.close()
    absent, answers, again = problems
    assert absent.startswith(f"No gatekeeper listens at {path}: No such file or directory. Start `dualbrain")
    assert (answers, bool(again)) == ("", True)


@pytest.mark.parametrize(
    "reply",
    [
        pytest.param(lambda number: b"", id="closed"),
        pytest.param(lambda number: os.urandom(400), id="random bytes"),
        pytest.param(lambda number: encode(18, number, b"\xc1\xff"), id="not MessagePack"),
        pytest.param(
            lambda number: encode(18, number, msgspec.msgpack.encode({"counts": {"x": 1}})), id="other fields"
        ),
        pytest.param(lambda number: encode(200, number, b""), id="unknown kind"),
        pytest.param(as_message(status("\n# HELP evil")), id="another message"),
    ],
)
def test_a_malformed_reply_is_no_answer(tmp_path, monkeypatch, reply):
    monkeypatch.setattr(gatekeeper_metrics, "REPLY_TIMEOUT_S", 0.2)
    gatekeeper, observer = FakeGatekeeper(tmp_path / "s", reply), GatekeeperObserver(tmp_path / "s")
    assert scrape(observer) == {("dualbrain_up",): 0.0}
    gatekeeper.close()
    good = FakeGatekeeper(tmp_path / "s", as_message(CountsReport(COUNTS)))
    assert scrape(observer)["dualbrain_up",] == 1.0
    good.close()
    observer.close()


def test_a_gatekeeper_without_counts_is_asked_once(tmp_path):
    refusal = RequestRefused("kind 17 is not known")
    older, problems = FakeGatekeeper(tmp_path / "s", as_message(refusal)), []
    observer = GatekeeperObserver(tmp_path / "s", problems.append)
    assert [scrape(observer) for _ in range(3)] == [{("dualbrain_up",): 0.0}] * 3
    assert (older.requests, problems) == (1, [refusal.reason])
    older.close()
    newer = FakeGatekeeper(tmp_path / "s", as_message(CountsReport(COUNTS)))
    assert scrape(observer)["dualbrain_up",] == 1.0
    newer.close()
    observer.close()
