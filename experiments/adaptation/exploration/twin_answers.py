"""Answers of planners in the kinematic twin.

    python -m experiments.adaptation.exploration.twin_answers QUESTIONS ANSWERS...

QUESTIONS is the folder of a data set whose held-out part are the questions, ANSWERS are files of `parallel_fits.py` or
`served_answers.py`. One JSON line per answer is printed: whether the gate accepts it, the outcome in the twin, and the
contract.
"""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.adaptation.curation.dataset import read_dataset
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.scoring import score_answer
from dualbrain.grounding.alternatives import SkillSteps
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.exploration.proposals import SOURCE
from dualbrain.runtime.data_collection.exploration.training_set import TWIN_SOURCE
from dualbrain.runtime.data_collection.exploration.trial import Trial, execute_in_twin
from dualbrain.runtime.data_collection.synthetic_scenes import scene_context_by_name
from experiments.adaptation.exploration.parallel_fits import Answer

EXECUTED_SOURCES = (SOURCE, TWIN_SOURCE)
"""Sources of the questions whose placements are executed; other answers are compared with the expected contract."""


def main() -> int:
    """Judge all answers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("questions", type=Path, help="data set whose held-out part are the questions")
    parser.add_argument("answers", type=Path, nargs="+", help="answers.jsonl of a fit")
    options = parser.parse_args()
    questions = read_dataset(options.questions).held_out
    by_id = {one.id: one for one in questions}
    for path in options.answers:
        for line in path.read_bytes().splitlines():
            answer = msgspec.json.decode(line, type=Answer)
            if answer.id in by_id:
                row = {"planner": path.parent.name, **judge_answer(by_id[answer.id], answer.text)}
                print(msgspec.json.encode(row).decode(), flush=True)
    return 0


def judge_answer(question: Sample, text: str) -> dict[str, Any]:
    """Compliance and correctness of an answer; a compliant and correct placement is executed in the twin."""
    context = scene_context_by_name(question.scene)
    score = score_answer(text, question.contract, load_skill_registry(context.registry.robot), context.accepts)
    row: dict[str, Any] = {
        "scene": question.scene,
        "kind": question.source,
        "compliant": score.compliant,
        "right": score.is_right,
        "contract": text,
    }
    steps = msgspec.json.decode(question.contract)["action_sequence"]
    if question.source not in EXECUTED_SOURCES or [one["skill"] for one in steps] != ["grasp", "place"]:
        return row
    names = (steps[0]["params"]["object"], steps[1]["params"]["destination"])
    trial = _execute(question.scene, *names, text) if score.is_right else None
    return row | {
        "outcome": trial.kind if trial else "rejected" if not score.compliant else "other objects",
        "Delta": trial.Delta if trial else None,
        "frequency": trial.intervention_frequency if trial else 0.0,
        "duration": trial.duration if trial else 0.0,
    }


@cache
def _execute(scene: str, object_name: str, destination: str, contract: str) -> Trial:
    """The contract in the twin; equal ones are executed once."""
    steps: SkillSteps = (("grasp", {"object": object_name}), ("place", {"destination": destination}))
    return execute_in_twin(Place(scene, steps), "answer", contract)


if __name__ == "__main__":
    raise SystemExit(main())
