"""A console in front of a fake robot, behind the access control of the real server."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

import uvicorn
from starlette.applications import Starlette

from dualbrain.agent_api.event_feed import EventFeed
from dualbrain.agent_server.access_control import LOOPBACK_HOSTS, AccessControl, AccessPolicy
from dualbrain.agent_server.console.routes import console_routes, is_public
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.contracts.verdict import Verdict
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from dualbrain.control.gatekeeper.protocol.messages import StatusReport
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants
from tests.planner.sample_requests import NAMES, SCENE

TOKEN = "a-token-for-these-tests"
REGISTRY = load_skill_registry("panda")


class FakeRobot:
    """A robot whose gate is the real one, and that records what it was asked to do."""

    name = "panda"

    def __init__(self) -> None:
        self.feed, self.checked, self.stops = EventFeed(), [], []
        self.lost = False
        self.summary, self.names = SCENE, NAMES
        self.reset()

    def reset(self) -> None:
        """Release all stops, which the console cannot do."""
        self._action, self._check = "NONE", ""

    def scene(self) -> dict[str, Any]:
        self._require_connection()
        return {
            "summary": self.summary,
            "graspable": list(self.names.graspable),
            "receptive": list(self.names.receptive),
            "holding": None,
            "robot": REGISTRY.robot,
            "registry": REGISTRY.hash,
            "next_id": "c-0001",
            "skills": describe_skills(REGISTRY, self.names),
        }

    def schema(self) -> dict[str, Any]:
        return decoding_schema(REGISTRY, self.names)

    def check(self, contract: bytes) -> Verdict:
        self._require_connection()
        self.checked.append(contract)
        gate = Gate(REGISTRY, planner_grants(REGISTRY))
        return gate.check(contract, names=self.names, principal=PLANNER, now=0.0)

    def events(self, after: int = 0) -> list[dict[str, Any]]:
        return self.feed.after(after)

    def status(self) -> StatusReport:
        return StatusReport(now=time.monotonic(), action=self._action, cause="", check=self._check, busy=False)

    def stop(self, *, emergency: bool = False) -> StatusReport:
        self.stops.append((emergency, time.time()))
        self._require_connection()
        self._action, self._check = ("ESTOP", "estop_pressed") if emergency else ("HOLD", "abort")
        return self.status()

    def _require_connection(self) -> None:
        if self.lost:
            raise ConnectionLostError("the gatekeeper closed the connection")


class ConsoleServer:
    """A running console: its robot, its folders and its address."""

    def __init__(self, folder: Path) -> None:
        self.robot, self.runs, self.ledger = FakeRobot(), folder / "runs", folder / "ledger.sqlite"
        self.ended = Event()
        routes = console_routes(self.robot, runs=self.runs, ledger=self.ledger, has_ended=self.ended.is_set)
        self.policy = AccessPolicy(token=TOKEN, hosts=LOOPBACK_HOSTS, port=0, is_public=is_public)
        self.app = AccessControl(Starlette(routes=routes), self.policy)
        self.url = ""

    @property
    def page(self) -> str:
        """Address of the page with the token in its fragment."""
        return f"{self.url}/console#token={TOKEN}"


@contextmanager
def serve_console(folder: Path) -> Iterator[ConsoleServer]:
    """A console on a free port of the loopback interface."""
    console = ConsoleServer(folder)
    config = uvicorn.Config(console.app, port=0, log_level="warning", access_log=False, lifespan="off", ws="none")
    server = uvicorn.Server(config)
    with config.bind_socket() as listener:
        port = listener.getsockname()[1]
        object.__setattr__(console.policy, "port", port)
        console.url = f"http://127.0.0.1:{port}"
        thread = Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            while not server.started:
                time.sleep(0.01)
            yield console
        finally:
            server.should_exit = server.force_exit = True
            thread.join()
