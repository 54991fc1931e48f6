"""The process that holds the model: llama.cpp on a loopback port, started and ended by `llama.py`.

It is a process of its own because llama.cpp aborts the whole process on some errors. It reads one line of settings from
standard input, writes one line with its address (or the reason why it could not start) to standard output, and lives
until its standard input closes, so that it never outlives its parent.
"""

import json
import os
import sys
from importlib import import_module
from typing import Any


def main() -> None:
    """Serve until standard input closes."""
    answer_to = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what llama.cpp prints must not mix with the answer
    try:
        server = _start(json.loads(sys.stdin.readline()))
        answer = {"address": server.listening_address}
    except Exception as error:  # every failure to start is told to the parent
        answer = {"error": f"{type(error).__name__}: {error}"}
    answer_to.write(json.dumps(answer) + "\n")
    answer_to.flush()
    sys.stdin.read()
    os._exit(0)


def _start(settings: dict[str, Any]) -> Any:
    xllamacpp = import_module("xllamacpp")  # here, so that a broken package is told to the parent too
    params = xllamacpp.CommonParams()
    params.model.path = settings["model"]
    params.n_ctx = settings["n_ctx"]
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = settings["threads"]
    params.api_keys = [settings["key"]]
    params.n_parallel = 1
    params.cache_ram_mib = 256
    params.sampling.temp = 0.0
    params.use_jinja = True
    params.warmup = params.ui = False
    params.endpoint_slots = bool(settings["prefixes"])
    params.slot_save_path = settings["prefixes"]
    params.verbosity = 0
    return xllamacpp.Server(params)


if __name__ == "__main__":
    main()
