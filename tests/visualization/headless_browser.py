"""Headless Chromium, controlled through the protocol of ChromeDriver: JSON over HTTP, without further packages."""

import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any, Self
from urllib.error import HTTPError
from urllib.request import ProxyHandler, Request, build_opener

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--enable-unsafe-swiftshader",
    "--use-gl=angle",
    "--use-angle=swiftshader",
)
STARTS = 5
"""Number of attempts to start chromedriver."""
TYPING_TIMEOUT = 10.0
"""Time [s] in which an element must be displayed before it is typed into."""
OPENER = build_opener(ProxyHandler({}))


def start_driver(program: str) -> tuple[subprocess.Popen[str], str]:
    """A running chromedriver and its port; if another program takes its port, it ends at once and is started again."""
    for _ in range(STARTS):
        driver = subprocess.Popen([program, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert driver.stdout is not None
        for line in driver.stdout:
            if "started successfully on port" in line:
                return driver, line.rstrip().rstrip(".").split()[-1]
        driver.stdout.close()
        driver.wait()
    raise AssertionError("chromedriver did not start")


class Browser:
    """A browser window."""

    def __init__(self, profile: Path, size: tuple[int, int] = (1280, 800), *extra: str) -> None:
        driver, chromium = shutil.which("chromedriver"), shutil.which("chromium")
        assert driver, "chromedriver is missing: apt-get install chromium-driver"
        assert chromium, "chromium is missing: apt-get install chromium"
        self._driver, port = start_driver(driver)
        self._base = f"http://127.0.0.1:{port}"
        flags = [*FLAGS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", *extra]
        capabilities = {
            "goog:chromeOptions": {"binary": chromium, "args": flags},
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        session = self._call("POST", "/session", {"capabilities": {"alwaysMatch": capabilities}})
        self._base += f"/session/{session['sessionId']}"

    def _call(self, method: str, path: str, body: object = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        with OPENER.open(
            Request(self._base + path, data, {"Content-Type": "application/json"}, method=method), timeout=60
        ) as response:
            return json.load(response)["value"]

    def open(self, url: str) -> None:
        """Load a page."""
        self._call("POST", "/url", {"url": url})

    def execute_script(self, script: str) -> Any:
        """Result of the script."""
        return self._call("POST", "/execute/sync", {"script": script, "args": []})

    def type(self, selector: str, text: str) -> None:
        """Type a text into an element, key by key without a pause, as soon as it can be typed into."""
        (element,) = self._call("POST", "/element", {"using": "css selector", "value": selector}).values()
        last_try = time.monotonic() + TYPING_TIMEOUT
        while True:
            try:
                self._call("POST", f"/element/{element}/value", {"text": text})
            except HTTPError as error:  # the driver sends no key to an element that is not displayed yet
                reason = error.read().decode()
                if "not interactable" not in reason or time.monotonic() > last_try:
                    raise AssertionError(reason) from error
                time.sleep(0.1)
            else:
                return

    def slow_down(self, factor: float, latency_ms: float, bytes_per_second: float) -> None:
        """Make the processor of the page slower by `factor`, and its network slow."""
        network = {"offline": False, "latency": latency_ms}
        rates = dict.fromkeys(("downloadThroughput", "uploadThroughput"), bytes_per_second)
        for command, parameters in (
            ("Emulation.setCPUThrottlingRate", {"rate": factor}),
            ("Network.enable", {}),
            ("Network.emulateNetworkConditions", network | rates),
        ):
            self._call("POST", "/goog/cdp/execute", {"cmd": command, "params": parameters})

    def send(self, path: str, body: object) -> Any:
        """Another command of the protocol, such as key strokes."""
        return self._call("POST", path, body)

    def enter_frame(self, index: int) -> None:
        """Run scripts in a frame of the page from now on."""
        self._call("POST", "/frame", {"id": index})

    def leave_frame(self) -> None:
        """Run scripts in the page again."""
        self._call("POST", "/frame", {"id": None})

    def wait_for(self, script: str, seconds: float = 30.0) -> Any:
        """First true result of the script."""
        until = time.monotonic() + seconds
        while not (result := self.execute_script(script)):
            assert time.monotonic() < until, f"never true in {seconds} s: {script}"
            time.sleep(0.1)
        return result

    def screenshot(self) -> str:
        """Image of the window as PNG in base64."""
        return self._call("GET", "/screenshot")

    def console_messages(self) -> list[str]:
        """Messages of the browser console."""
        return [line["message"] for line in self._call("POST", "/se/log", {"type": "browser"})]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._call("DELETE", "")
        finally:
            self._driver.terminate()
            with self._driver:
                self._driver.wait(10)
