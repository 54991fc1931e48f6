"""The routes of the console, for the server that protects them (`AccessControl`)."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from secrets import token_hex
from typing import Any, TypeVar

import anyio
import anyio.to_thread
import msgspec
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from dualbrain.agent_api.tools import verdict_view
from dualbrain.agent_server.console.console_robot import ConsoleRobot
from dualbrain.agent_server.console.event_stream import StatusAge, StreamStart, event_response
from dualbrain.agent_server.console.memory_table import list_memories
from dualbrain.agent_server.console.report_tickets import ReportTickets
from dualbrain.agent_server.console.responses import REPORT_POLICY, error_response, json_response, response
from dualbrain.agent_server.console.run_list import list_runs, read_report
from dualbrain.core.untrusted.bounded_file import FileRefusal
from dualbrain.errors import DECODE_ERRORS, DualbrainError
from dualbrain.visualization.html.page import palette_css

CONSOLE_PATH = "/console"
PUBLIC_FOLDERS = (f"{CONSOLE_PATH}/static/", f"{CONSOLE_PATH}/reports/")
"""Paths without a token: files that contain nothing about the robot, and reports, which need a ticket."""
MEDIA_TYPES = {".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css"}
STOP_THREADS = 4
"""Threads for stops only, so that a stop never waits for another request."""
T = TypeVar("T")


def is_public(path: str) -> bool:
    """Whether a request for `path` needs no token."""
    return path == CONSOLE_PATH or path.startswith(PUBLIC_FOLDERS)


def console_routes(
    robot: ConsoleRobot, *, runs: Path, ledger: Path | None, has_ended: Callable[[], bool] = lambda: False
) -> list[Route]:
    """The page of the console for `robot`, with the run folders in `runs` and the memory `ledger`, and its requests.

    Event streams end when `has_ended` returns True. The routes check neither host nor token: `AccessControl` does, with
    `is_public`.
    """
    console = Console(robot, runs, ledger, has_ended)
    files = [_static(one.name, one.read_bytes()) for one in _static_folder().iterdir() if one.name != "page.html"]
    page = _static_folder().joinpath("page.html").read_bytes()
    return [
        _static_route(CONSOLE_PATH, page, MEDIA_TYPES[".html"]),
        _static_route(f"{CONSOLE_PATH}/static/palette.css", palette_css().encode(), MEDIA_TYPES[".css"]),
        *files,
        Route(f"{CONSOLE_PATH}/reports/{{ticket}}", console.report),
        Route(f"{CONSOLE_PATH}/api/scene", console.scene),
        Route(f"{CONSOLE_PATH}/api/schema", console.schema),
        Route(f"{CONSOLE_PATH}/api/events", console.events),
        Route(f"{CONSOLE_PATH}/api/runs", console.list_runs),
        Route(f"{CONSOLE_PATH}/api/memory", console.memory),
        Route(f"{CONSOLE_PATH}/api/check", console.check, methods=["POST"]),
        Route(f"{CONSOLE_PATH}/api/tickets", console.ticket, methods=["POST"]),
        Route(f"{CONSOLE_PATH}/api/stop", console.stop, methods=["POST"]),
    ]


class Console:
    """The requests of the page."""

    def __init__(self, robot: ConsoleRobot, runs: Path, ledger: Path | None, has_ended: Callable[[], bool]) -> None:
        """Answer for `robot`, `runs` and `ledger`."""
        self._robot, self._runs, self._ledger, self._has_ended = robot, runs, ledger, has_ended
        self._tickets, self._server_id = ReportTickets(time.monotonic), token_hex(8)
        self._stops = anyio.CapacityLimiter(STOP_THREADS)

    async def scene(self, request: Request) -> Response:
        """The perceived scene."""
        del request
        return await _answer(lambda: {**self._robot.scene(), "name": self._robot.name})

    async def schema(self, request: Request) -> Response:
        """The schema of a contract."""
        del request
        return await _answer(self._robot.schema)

    async def check(self, request: Request) -> Response:
        """The gate's verdict on the body, byte for byte."""
        contract = await request.body()
        return await _answer(lambda: verdict_view(self._robot.check(contract)))

    async def events(self, request: Request) -> Response:
        """The events after the number in the query, as a stream; the query also has the id of its server."""
        after = request.query_params.get("after", "0")
        number = int(after) if after.isdecimal() and len(after) < 16 else 0
        start = StreamStart(number, request.query_params.get("server"))
        return event_response(self._robot, start, self._server_id, self._has_ended)

    async def list_runs(self, request: Request) -> Response:
        """The runs in the run folder."""
        del request
        return await _answer(lambda: list_runs(self._runs))

    async def memory(self, request: Request) -> Response:
        """The memories of the ledger."""
        del request
        return await _answer(lambda: list_memories(self._ledger))

    async def ticket(self, request: Request) -> Response:
        """A path at which the report of a run can be loaded once."""
        run = _field(await request.body(), "run", str)
        return json_response({"path": f"{CONSOLE_PATH}/reports/{self._tickets.issue(run or '')}"})

    async def report(self, request: Request) -> Response:
        """The report of a ticket, in a sandbox."""
        run = self._tickets.redeem(request.path_params["ticket"])
        found = await anyio.to_thread.run_sync(lambda: read_report(self._runs, run))
        if isinstance(found, FileRefusal):
            sentence = "This report cannot be shown: open it again from the list of runs, or in its run folder."
            return response(sentence.encode(), "text/plain", status=404, policy=REPORT_POLICY)
        return response(found, MEDIA_TYPES[".html"], policy=REPORT_POLICY)

    async def stop(self, request: Request) -> Response:
        """Stop the robot; an emergency stop unless the body states {"emergency": false}."""
        emergency = _field(await request.body(), "emergency", bool) is not False
        return await _answer(lambda: StatusAge().view(self._robot.stop(emergency=emergency)), self._stops)


async def _answer(function: Callable[[], Any], limiter: anyio.CapacityLimiter | None = None) -> Response:
    """The result of a blocking call as JSON; an error of the robot becomes a sentence with status 503."""
    try:
        return json_response(await anyio.to_thread.run_sync(function, limiter=limiter))
    except DualbrainError as error:
        return error_response(str(error), 503)


def _field(body: bytes, name: str, kind: type[T]) -> T | None:
    """The value of a field of a JSON object; None if there is none of this type."""
    try:
        value = msgspec.json.decode(body, type=dict[str, Any]).get(name)
    except (*DECODE_ERRORS, UnicodeError):
        return None
    return value if isinstance(value, kind) else None


def _static_folder() -> Any:
    return resources.files("dualbrain.agent_server.console").joinpath("static")


def _static(name: str, content: bytes) -> Route:
    return _static_route(f"{CONSOLE_PATH}/static/{name}", content, MEDIA_TYPES[Path(name).suffix])


def _static_route(path: str, content: bytes, media_type: str) -> Route:
    async def serve(request: Request) -> Response:
        del request
        return response(content, media_type)

    return Route(path, serve)
