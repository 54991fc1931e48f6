"""A proof for the tests of the crew: it doubles, breaks or dies."""

import os
import time


class Doubling:
    name = "doubling"
    claim = "2 n = n + n"

    def run(self, about):
        if about.get("die"):
            os._exit(9)
        time.sleep(about.get("nap", 0.0))
        return {"double": about["n"] + about["n"], "inverse": 1 / about["n"], "worker": os.getpid()}


EXPERIMENTS = {"doubling": Doubling()}
