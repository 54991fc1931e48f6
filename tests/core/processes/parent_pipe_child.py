"""Children of `start_child` in tests: each writes what happens to it into a file."""

import os
import time
from pathlib import Path


def main(arguments, pipe):
    kind, path = arguments[0], Path(arguments[1])
    if kind == "hang at start":
        path.write_text(f"{os.getpid()}")
        time.sleep(60.0)
    settings = pipe.read_settings()
    if kind == "report":
        pipe.on_end(lambda: path.with_suffix(".end").write_text("ended"), grace=0.3)
    elif kind == "hang":
        pipe.on_end(lambda: time.sleep(0.1), grace=0.3)
    elif kind == "raise":
        pipe.on_end(lambda: 1 / 0, grace=0.3)
    path.with_suffix(".tmp").write_text(f"{os.getpid()} {len(settings)} {os.getsid(0)}")
    path.with_suffix(".tmp").replace(path)
    while kind != "return":
        time.sleep(1.0)
