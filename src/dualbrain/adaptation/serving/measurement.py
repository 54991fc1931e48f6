"""What the promotion gate wants to know of a planner: asked in the runtime that serves, with nothing that binds it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from dualbrain.adaptation.adapters.promotion import LEAST, Results, Trial
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.serving.perplexity import perplexity, retention_text
from dualbrain.adaptation.serving.raw_completion import Said, say
from dualbrain.adaptation.synthetic.scoring import score
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.verdict import Accepted
from dualbrain.errors import DualbrainError, InvalidSetup
from dualbrain.planner.backends.http_chat import Answer
from dualbrain.planner.backends.llama_cpp import LlamaPlanner

Flight = Callable[[Sample, str], tuple[bool, float | None]]
"""Success and Δ of a contract's text carried out in the scene of a sample; handed in by who can move a body."""
Tell = Callable[[int, int, Trial], None]
LONGEST = 640
"""Tokens of an answer; one that does not end by then is no contract."""


class NoAnswer(DualbrainError):
    """The runtime gave no answer where one had to be measured."""

    def __init__(self, answer: Answer) -> None:
        """Say what came instead."""
        self.answer = answer
        super().__init__(f"no answer to measure: {answer.finish} {answer.detail}".rstrip() + ". Measure again.")


def questions(samples: Sequence[Sample], most: int = 0) -> tuple[Sample, ...]:
    """At most `most` of the held-out `samples` (0: all), evenly chosen; raises `InvalidSetup` if they are too few."""
    count = min(most or len(samples), len(samples))
    if count < LEAST:
        fix = "With fewer, no difference that matters could be told from chance."
        raise InvalidSetup("held-out questions", got=count, allowed=f"at least {LEAST}", fix=fix)
    return tuple(samples[row * len(samples) // count] for row in range(count))


def of_robot(samples: Sequence[Sample], robot: str) -> tuple[Sample, ...]:
    """Those of `samples` that are about `robot`: a data set may speak of several."""
    return tuple(one for one in samples if msgspec.json.decode(one.contract, type=Contract).context.robot == robot)


def measure(
    planner: LlamaPlanner, asked: Sequence[Sample], registry: Registry, *, adapter: str, runtime: str,
    fly: Flight | None = None, tell: Tell = lambda done, of, trial: None,
) -> Results:  # fmt: skip
    """One free greedy answer to each question, judged by gate, by the contract that did it, and by `fly`.

    Declining complies only where the contract that is known to be right declines. Of the envelope only bounds and names
    are asked, as in `gate_judge`: what geometry and body refuse counts as compliant, and `fly`, which stands behind the
    whole gate, tells it as no success. Raises `NoAnswer`.
    """
    gate, trials = Gate(registry, {"planner": frozenset(registry.by_name)}), list[Trial]()
    for number, sample in enumerate(asked, start=1):
        said = say(planner, sample.prompt, longest=LONGEST)
        if isinstance(said, Answer):
            raise NoAnswer(said)
        trials.append(_trial(sample, said, registry, gate, fly))
        tell(number, len(asked), trials[-1])
    kept = perplexity(planner, retention_text())
    if isinstance(kept, Answer):
        raise NoAnswer(kept)
    return Results(adapter, runtime, kept, tuple(trials))


def _trial(sample: Sample, said: Said, registry: Registry, gate: Gate, fly: Flight | None) -> Trial:
    def accepts(data: bytes) -> bool:
        return isinstance(gate.check(data, names=sample.names, principal="planner", now=0.0), Accepted)

    found = score(said.text if said.whole else "", sample.contract, registry, accepts)
    if fly is None:
        return Trial(sample.id, found.compliant, found.right)
    success, Delta = fly(sample, said.text) if found.compliant else (False, None)
    return Trial(sample.id, found.compliant, found.right, success, Delta)
