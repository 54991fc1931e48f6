"""A chat server on loopback with a given behaviour, for tests of faulty responses."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Behaviour = Callable[[BaseHTTPRequestHandler], None]


def chat_completion(text: str | None, finish: Any = "stop", **message: Any) -> bytes:
    """A valid chat completion."""
    choice = {"index": 0, "finish_reason": finish, "message": {"role": "assistant", "content": text, **message}}
    usage = {"prompt_tokens": 100, "completion_tokens": 20}
    return json.dumps({"choices": [choice], "usage": usage}).encode()


def respond_with(body: bytes, status: int = 200) -> Behaviour:
    """Respond with `body` immediately."""

    def behave(call: BaseHTTPRequestHandler) -> None:
        call.send_response(status)
        call.send_header("Content-Length", str(len(body)))
        call.end_headers()
        call.wfile.write(body)

    return behave


class FakeServer(ThreadingHTTPServer):
    """Stores path and body of each request in `requests` and its headers in `headers`."""

    daemon_threads = True

    def __init__(self, behaviour: Behaviour) -> None:
        self.behaviour, self.requests, self.headers, self.closing = behaviour, [], [], threading.Event()
        super().__init__(("127.0.0.1", 0), _Handler)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that disconnect, as some tests do."""


class _Handler(BaseHTTPRequestHandler):
    server: FakeServer

    def do_POST(self) -> None:
        length = int(self.headers["Content-Length"])
        self.server.requests.append((self.path, json.loads(self.rfile.read(length))))
        self.server.headers.append(dict(self.headers))
        self.server.behaviour(self)

    def log_message(self, format: str, *args: object) -> None:
        """Write no log."""


@contextmanager
def serve(behaviour: Behaviour) -> Iterator[FakeServer]:
    """A server with this `behaviour`, which runs inside the context."""
    with FakeServer(behaviour) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.closing.set()
            server.shutdown()
            thread.join()
