"""A process in another interpreter answers unit after unit, and its end is an error with the end of its stderr."""

import sys
from pathlib import Path

import pytest

from experiments.engine.pipe_protocol import PipeError
from experiments.engine.worker_process import WorkerProcess


def test_a_worker_answers_every_unit_with_its_versions_and_reports_its_end():
    worker = WorkerProcess("the suite", Path(sys.executable), "tests.experiments.engine.echoing_worker", "1.2")
    for number in (1, 2):
        assert worker.run({"number": number}) == {"echo": {"number": number}, "versions": {"suite": "1.2"}}
    with pytest.raises(PipeError, match=r"(?s)stderr of the suite.*the end of it"):
        worker.run({"end": True})
    with pytest.raises(PipeError, match="has been ended"):
        worker.run({"number": 3})


def test_a_worker_that_does_not_start_is_an_error():
    with pytest.raises(PipeError, match="No module named"):
        WorkerProcess("the suite", Path(sys.executable), "tests.experiments.engine.no_such_module")
