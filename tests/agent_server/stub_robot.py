"""A robot without a gatekeeper: its gate is that of a simulated cell, and it moves nothing."""

from __future__ import annotations

import threading

from dualbrain.agent_api.submission import SubmissionReport
from dualbrain.agent_api.tools import call_tool, export_tools, robot_tools
from dualbrain.contracts.verdict import Accepted
from dualbrain.runtime.assembly import SimulatedCell


class StubRobot:
    """Keeps the bytes that reach it in `checked` and `submitted`, with the author of each submission."""

    name, has_planner = "panda", False

    def __init__(self) -> None:
        self.cell = SimulatedCell.make("panda", "bare:0")
        self.checked: list[bytes] = []
        self.submitted: list[tuple[bytes, str]] = []
        self.stops: list[bool] = []
        self._lock = threading.Lock()  # the plant of the cell is for one thread

    def scene(self):
        return {"robot": "panda", "registry": "83abdb38", "next_id": "c-0001", "skills": "", "summary": ""}

    def schema(self, form="decoding"):
        return {"type": "object", "title": form}

    def check(self, contract):
        with self._lock:
            self.checked.append(contract)
            return self.cell.check(contract)

    def run(self, contract, instruction="", *, client, timeout):
        self.submitted.append((contract, client))
        verdict = self.check(contract)
        if isinstance(verdict, Accepted):
            return SubmissionReport(id="c-0001", state="finished", contract={})
        return SubmissionReport(id="c-0001", state="rejected", rejected=verdict)

    def outcome(self, submission_id="", *, timeout=0.0):
        return None

    def stop(self, *, emergency=False):
        self.stops.append(emergency)

    def events(self, after=0):
        return []

    def recent(self):
        return []

    def tools(self, form="openai"):
        return export_tools(robot_tools(self), form)

    def call(self, name, arguments=b"{}", *, client="agent"):
        return call_tool(self, name, arguments, client=client)
