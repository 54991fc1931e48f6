"""The process that holds the model: llama.cpp on a loopback port, started and ended by `llama_process.py`.

It is a process of its own because llama.cpp aborts the whole process on some errors. It reads one line of settings from
standard input, writes one line with its address (or the reason why it could not start) to standard output, and lives
until its standard input closes, so that it never outlives its parent, not even while it loads.
"""

import fcntl
import json
import os
import select
import sys
from importlib import import_module
from typing import Any


def main() -> None:
    """Serve until standard input closes."""
    answer_to = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what llama.cpp prints must not mix with the answer
    try:
        settings = json.loads(sys.stdin.readline())
        _exit_when_closed(sys.stdin.fileno())
        server = _start(settings)
        answer = {"address": server.listening_address}
    except Exception as error:  # every failure to start is told to the parent
        answer = {"error": f"{type(error).__name__}: {error}"}
    answer_to.write(json.dumps(answer) + "\n")
    answer_to.flush()
    sys.stdin.read()
    os._exit(0)


def _exit_when_closed(pipe: int) -> None:
    """Let the kernel end this process (SIGIO) when the other end of `pipe` closes.

    A thread could not: while the model loads, Python's lock is held for seconds.
    """
    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([pipe], [], [], 0.0)[0]:  # closed before the kernel was asked
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
    if settings["adapters"]:
        params.lora_adapters = [xllamacpp.CommonAdapterLoraInfo(path, 1.0) for path in settings["adapters"]]
        params.lora_init_without_apply = True  # each request says which of them act, and how much
        params.cache_ram_mib = 0
    return xllamacpp.Server(params)


if __name__ == "__main__":
    main()
