"""A worker that echoes its parameters, and ends at `{"end": true}`; it prints text that is no message."""

import sys

from experiments.engine.worker_process import serve


def echo(parameters):
    print("a library prints")  # noqa: T201
    if parameters.get("end"):
        sys.exit("the end of it")
    return {"echo": parameters}


if __name__ == "__main__":
    serve({"suite": sys.argv[1]}, echo)
