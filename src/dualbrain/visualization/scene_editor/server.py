"""Server of the editor's page on the loopback address.

Only the page itself can use it: every request must name this address as its host, and every request that sends a scene
must carry the token of the page.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path

import msgspec

from dualbrain.core.untrusted.visible_text import visible_text
from dualbrain.simulation.scenes.scene_spec import SceneSpec, save_scene
from dualbrain.visualization.html.page import palette_css
from dualbrain.visualization.scene_editor.edited_scene import page_data, read_edited_scene

HOST = "127.0.0.1"
MAX_REQUEST_BYTES = 1 << 18
TOKEN_HEADER = "X-Editor-Token"


class SceneEditorServer(ThreadingHTTPServer):
    """Serves the page for the scene `original`, and writes the file `path` when a scene without problems is saved.

    `on_save` is called after each save, on a thread of the server.
    """

    daemon_threads = True

    def __init__(self, original: SceneSpec, path: Path, port: int, on_save: Callable[[], None]) -> None:
        """Listen on `port` (0: any free one). Raises `OSError` if it is in use."""
        super().__init__((HOST, port), _Handler)
        self.original, self.path, self.on_save = original, path, on_save
        self.token, self.nonce = secrets.token_urlsafe(24), secrets.token_urlsafe(16)
        self.url = f"http://{HOST}:{self.server_port}/"

    def page(self) -> str:
        """The page with its script, its style sheet and its data."""
        folder = resources.files("dualbrain.visualization.scene_editor")
        template, script = (folder.joinpath(name).read_text("utf-8") for name in ("page.html", "page.js"))
        data = json.dumps(page_data(self.original)).replace("<", "\\u003c")
        values = {"STYLE": palette_css(), "NONCE": self.nonce, "TOKEN": self.token, "DATA": data, "SCRIPT": script}
        return re.sub(r"@([A-Z]+)@", lambda found: values[found[1]], template)

    def receive(self, content: bytes, *, save: bool) -> tuple[list[str], str]:
        """The problems of the scene that the page sent, and the name of the file if it was saved."""
        spec, problems = read_edited_scene(content, self.original)
        if spec is None or problems or not save:
            return problems, ""
        save_scene(spec, self.path)
        self.on_save()
        return [], str(self.path)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 30

    def do_GET(self) -> None:
        """Send the page."""
        if not self._is_own_host() or self.path != "/":
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"not found")
            return
        self._answer(HTTPStatus.OK, "text/html; charset=utf-8", self._editor.page().encode())

    def do_POST(self) -> None:
        """Check a scene, and save it if that is requested."""
        length = self.headers.get("Content-Length", "")
        token = self.headers.get(TOKEN_HEADER, "")
        allowed = self._is_own_host() and hmac.compare_digest(token.encode(), self._editor.token.encode())
        if not allowed or self.path not in ("/check", "/save"):
            self.close_connection = True
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"only the page of the editor may send a scene")
        elif not length.isdecimal() or int(length) > MAX_REQUEST_BYTES:
            self.close_connection = True
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "text/plain", b"the scene is too large")
        else:
            try:
                problems, saved = self._editor.receive(self.rfile.read(int(length)), save=self.path == "/save")
            except OSError as error:
                problems, saved = [f"The file cannot be written: {error}"], ""
            answer = {"problems": [visible_text(one) for one in problems], "saved": saved}
            self._answer(HTTPStatus.OK, "application/json", msgspec.json.encode(answer))

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    @property
    def _editor(self) -> SceneEditorServer:
        assert isinstance(self.server, SceneEditorServer)
        return self.server

    def _is_own_host(self) -> bool:
        port = self._editor.server_port
        return self.headers.get("Host", "").lower() in (f"{HOST}:{port}", f"localhost:{port}")

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        script, style = f"script-src 'nonce-{self._editor.nonce}'", "style-src 'unsafe-inline'"
        policy = f"default-src 'none'; {script}; {style}; connect-src 'self'"
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(content))),
            ("Content-Security-Policy", f"{policy}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"),
            ("X-Content-Type-Options", "nosniff"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
