"""Time the first paint of the console in headless Chromium, beside a simulated robot in real time.

`python -m scripts.time_console` starts `dualbrain console --scene 8`, loads the page ten times, and prints the time
from the request to the first paint with content [ms], and the load of the machine before and after.
"""

from __future__ import annotations

import os
import secrets
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.agent_server.clients.test_clients import free_port
from tests.visualization.headless_browser import Browser

LOADS, SETTLING_TIME_S = 10, 10.0
READY = "return document.querySelector('#verdict b') && performance.getEntriesByName('first-contentful-paint').length"
PAINT = "return performance.getEntriesByName('first-contentful-paint')[0].startTime"


def main() -> None:
    """Print the times."""
    token, port = secrets.token_urlsafe(24), free_port()
    with tempfile.TemporaryDirectory() as home:
        environment = os.environ | {"DUALBRAIN_HOME": home, "DUALBRAIN_TOKEN": token}
        command = [sys.executable, "-m", "dualbrain", "console", "--scene", "8", "--port", str(port)]
        with subprocess.Popen(command, env=environment, cwd=home, stderr=subprocess.PIPE, text=True) as server:
            try:
                assert server.stderr is not None
                assert any("Console: " in line for line in server.stderr), "the console did not start"
                time.sleep(SETTLING_TIME_S)
                before = os.getloadavg()[0]
                times = load_pages(f"http://127.0.0.1:{port}/console#token={token}", Path(home) / "profile")
            finally:
                server.send_signal(signal.SIGTERM)
    print(f"first paint [ms]: median {statistics.median(times):.0f}, range {min(times):.0f} to {max(times):.0f}")
    print(f"each load [ms]: {' '.join(f'{one:.0f}' for one in times)}")
    print(f"load of the machine: {before:.1f} before, {os.getloadavg()[0]:.1f} after")


def load_pages(address: str, profile: Path) -> list[float]:
    """The time of the first paint of each load [ms]; the first one fills the caches of the browser, and counts."""
    times = list[float]()
    with Browser(profile) as browser:
        for _ in range(LOADS):
            browser.open("about:blank")
            browser.open(address)
            browser.wait_for(READY)
            times.append(float(browser.execute_script(PAINT)))
    return times


if __name__ == "__main__":
    main()
