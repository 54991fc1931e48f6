"""The worker process with the model: llama.cpp on a loopback port, started and stopped by `llama_process.py`.

A separate process is needed because llama.cpp aborts the whole process on some errors. The worker reads one line of
settings from standard input, writes one line with its address (or the reason why it could not start) to standard
output, and runs until its standard input closes, so that it never outlives its parent, not even while it loads.
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
    reply_to = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of llama.cpp must not mix with the reply
    try:
        settings = json.loads(sys.stdin.readline())
        _exit_when_closed(sys.stdin.fileno())
        server = _start(settings)
        reply = {"address": server.listening_address}
    except Exception as error:  # every failure to start is reported to the parent
        reply = {"error": f"{type(error).__name__}: {error}"}
    reply_to.write(json.dumps(reply) + "\n")
    reply_to.flush()
    sys.stdin.read()
    os._exit(0)


def _exit_when_closed(pipe: int) -> None:
    """Let the operating system end this process (SIGIO) when the other end of `pipe` closes.

    A thread could not do this: while the model loads, the global interpreter lock is held for seconds.
    """
    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([pipe], [], [], 0.0)[0]:  # the pipe was closed before
        os._exit(0)


def _start(settings: dict[str, Any]) -> Any:
    xllamacpp = import_module("xllamacpp")  # imported here, so that a broken package is reported to the parent
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
    params.endpoint_slots = bool(settings["prompt_cache"])
    params.slot_save_path = settings["prompt_cache"]
    params.verbosity = 0
    if settings["adapters"]:
        params.lora_adapters = [xllamacpp.CommonAdapterLoraInfo(path, 1.0) for path in settings["adapters"]]
        params.lora_init_without_apply = True  # each request lists the adapters and their scales
        params.cache_ram_mib = 0
    return xllamacpp.Server(params)


if __name__ == "__main__":
    main()
