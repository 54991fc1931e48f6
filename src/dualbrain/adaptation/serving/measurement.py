"""What the promotion gate wants to know of a planner: asked in the runtime that serves, with nothing that binds it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from dualbrain.adaptation.adapters.promotion import MIN_QUESTIONS, PlannerResults, QuestionResult
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.serving.perplexity import perplexity, retention_text
from dualbrain.adaptation.serving.raw_completion import RawCompletion, complete
from dualbrain.adaptation.synthetic.scoring import score_answer
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Accepted
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaPlanner

ExecuteContract = Callable[[Sample, str], tuple[bool, float | None]]
"""Success and Δ of a contract's text carried out in the scene of a sample; handed in by who can move a body."""
ReportResult = Callable[[int, int, QuestionResult], None]
MAX_ANSWER_TOKENS = 640
"""Tokens of an answer; one that does not end by then is no contract."""


class NoAnswerError(DualbrainError):
    """The runtime gave no answer where one had to be measured."""

    def __init__(self, response: ChatResponse) -> None:
        """Say what came instead."""
        self.response = response
        super().__init__(
            f"no answer to measure: {response.finish_reason} {response.detail}".rstrip() + ". Measure again."
        )


def select_questions(samples: Sequence[Sample], max_questions: int = 0) -> tuple[Sample, ...]:
    """At most `most` of the held-out `samples` (0: all), evenly chosen; raises `InvalidSetup` if they are too few."""
    count = min(max_questions or len(samples), len(samples))
    if count < MIN_QUESTIONS:
        fix = "With fewer, no difference that matters could be told from chance."
        raise ConfigurationError("held-out questions", got=count, allowed=f"at least {MIN_QUESTIONS}", fix=fix)
    return tuple(samples[row * len(samples) // count] for row in range(count))


def samples_for_robot(samples: Sequence[Sample], robot: str) -> tuple[Sample, ...]:
    """Those of `samples` that are about `robot`: a data set may speak of several."""
    return tuple(one for one in samples if msgspec.json.decode(one.contract, type=Contract).context.robot == robot)


def measure_planner(
    planner: LlamaPlanner,
    asked: Sequence[Sample],
    registry: SkillRegistry,
    *,
    adapter: str,
    runtime: str,
    execute: ExecuteContract | None = None,
    report: ReportResult = lambda done, of, trial: None,
) -> PlannerResults:
    """One free greedy answer to each question, judged by gate, by the contract that did it, and by `fly`.

    Declining complies only where the contract that is known to be right declines. Of the envelope only bounds and names
    are asked, as in `gate_judge`: what geometry and body refuse counts as compliant, and `fly`, which stands behind the
    whole gate, tells it as no success. Raises `NoAnswer`.
    """
    gate, trials = Gate(registry, {"planner": frozenset(registry.by_name)}), list[QuestionResult]()
    for number, sample in enumerate(asked, start=1):
        said = complete(planner, sample.prompt, max_tokens=MAX_ANSWER_TOKENS)
        if isinstance(said, ChatResponse):
            raise NoAnswerError(said)
        trials.append(_measure_question(sample, said, registry, gate, execute))
        report(number, len(asked), trials[-1])
    kept = perplexity(planner, retention_text())
    if isinstance(kept, ChatResponse):
        raise NoAnswerError(kept)
    return PlannerResults(adapter, runtime, kept, tuple(trials))


def _measure_question(
    sample: Sample, said: RawCompletion, registry: SkillRegistry, gate: Gate, fly: ExecuteContract | None
) -> QuestionResult:
    def accepts(data: bytes) -> bool:
        return isinstance(gate.check(data, names=sample.scene_names, principal="planner", now=0.0), Accepted)

    found = score_answer(said.text if said.is_complete else "", sample.contract, registry, accepts)
    if fly is None:
        return QuestionResult(question=sample.id, compliant=found.compliant, right=found.is_right)
    success, Delta = fly(sample, said.text) if found.compliant else (False, None)
    return QuestionResult(
        question=sample.id, compliant=found.compliant, right=found.is_right, success=success, Delta=Delta
    )
