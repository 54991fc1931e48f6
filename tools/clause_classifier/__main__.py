"""Trains the classifier of clauses, or states how well it judges sentences that it was not trained on.

    python -m tools.clause_classifier               # five-fold cross-validation
    python -m tools.clause_classifier --write       # train with all sentences and write the packaged weights

Training needs torch (`make setup` installs it), the sentence encoder (`dualbrain models fetch`), and about five minutes
on two cores. Folds split single sentences, so that near copies of a packaged sentence are in both parts. The held-out
sets are measured by `python -m experiments clauses`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.progress import track
from safetensors.numpy import save_file

from dualbrain.core.weights import default_cache_folder
from dualbrain.grounding.instruction.clauses import clause_classifier
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from tools.clause_classifier.sentences import training_sentences
from tools.clause_classifier.training import Example, make_examples, scores, train, weights_of

FOLDS = 5


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 on success."""
    parser = argparse.ArgumentParser(prog="python -m tools.clause_classifier", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write the packaged weights")
    options = parser.parse_args(arguments)
    sentences = training_sentences()
    with_clause = sum(one.clause for one in sentences)
    print(f"{len(sentences)} sentences, {with_clause} with a clause")
    examples = make_examples(sentences, MiniLmEncoder.from_cache(default_cache_folder(os.environ)))
    if options.write:
        _write(examples)
    else:
        _validate(examples)
    return 0


def _write(examples: Sequence[Example]) -> None:
    target = clause_classifier.__file__.replace("clause_classifier.py", clause_classifier.WEIGHTS_FILE)
    save_file(weights_of(train(examples)), target)
    print("the packaged weights are written")


def _validate(examples: Sequence[Example]) -> None:
    fold = np.random.default_rng(0).integers(0, FOLDS, len(examples))
    found = np.zeros(len(examples))
    for k in track(range(FOLDS), "folds", console=Console(stderr=True)):
        layer = train([one for one, f in zip(examples, fold, strict=True) if f != k])
        found[fold == k] = scores(layer, [one for one, f in zip(examples, fold, strict=True) if f == k])
    clause = np.array([one.clause for one in examples], bool)
    print(
        f"with a clause: {(found[clause] > 0).mean():.1%} found; without one: {(found[~clause] < 0).mean():.1%} passed"
    )


if __name__ == "__main__":
    sys.exit(main())
