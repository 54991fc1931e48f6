"""Answers of a planner as it serves.

    python -m experiments.adaptation.exploration.served_answers PLANNER QUESTIONS OUT

QUESTIONS is the folder of a data set whose held-out part are the questions. In contrast to the answers of
`parallel_fits.py`, the grammar of the scene constrains them, and the planner runs in llama.cpp. `PLANNER+example` shows
the worked example of method PE, `PLANNER+fixed` that of method PE-fixed. Existing answers in OUT are kept.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from dualbrain.adaptation.curation.dataset import read_dataset
from dualbrain.core import paths
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.evaluation.planners.few_shot import BEST_FIXED, NO_CHANGE, FewShotPlanner
from dualbrain.planner.protocol import Planner
from dualbrain.runtime.data_collection.rollouts import ROBOT, build_request

WORKED_EXAMPLES = {"example": NO_CHANGE, "fixed": BEST_FIXED}
"""Parameters that replace those of the worked example, by the word after the planner's name."""


def main() -> int:
    """Ask all questions that have no answer yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("planner", help="base-135m, starter-135m, value:FILE, adapter:FOLDER …")
    parser.add_argument("questions", type=Path, help="data set whose held-out part are the questions")
    parser.add_argument("out", type=Path, help="file of the answers, JSON lines")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    log = JsonlLog(options.out)
    answered = {row["id"] for row in log.read()}
    planner = open_named(options.planner)
    for question in read_dataset(options.questions).held_out:
        if question.id not in answered:
            start = time.monotonic()
            proposal = planner.propose(build_request(question))
            log.append({"id": question.id, "text": proposal.text, "seconds": time.monotonic() - start})
    planner.close()
    return 0


def open_named(name: str) -> Planner:
    """The planner called `name`, with a worked example if the name ends in one."""
    core, _, example = name.partition("+")
    planner = PlannerSources(paths.cache_folder(), paths.dualbrain_home() / "adapters").open(core, ROBOT)
    return FewShotPlanner(planner, WORKED_EXAMPLES[example]) if example else planner


if __name__ == "__main__":
    raise SystemExit(main())
