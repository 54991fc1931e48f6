"""Measurement of a planner for the promotion gate: unconstrained answers in the runtime that serves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from dualbrain.adaptation.adapters.promotion import (
    MIN_QUESTIONS,
    MIN_SCENES,
    PlannerResults,
    QuestionResult,
    scene_of,
)
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
"""Success and Δ of a contract's text, executed in the scene of a sample; a caller that can move a robot provides it."""
ReportResult = Callable[[int, int, QuestionResult], None]
MAX_ANSWER_TOKENS = 640
"""Maximum number of tokens of an answer; an answer that is cut there is not a contract."""


class NoAnswerError(DualbrainError):
    """The runtime gave no answer during a measurement."""

    def __init__(self, response: ChatResponse) -> None:
        """Report the response that came instead."""
        self.response = response
        super().__init__(
            f"The runtime gave no answer: {response.finish_reason} {response.detail}".rstrip() + ". Measure again."
        )


def select_questions(samples: Sequence[Sample], max_questions: int = 0) -> tuple[Sample, ...]:
    """At most `max_questions` (0: all) evenly chosen held-out `samples`.

    Raises `ConfigurationError` if they, or their scenes, are too few.
    """
    count = min(max_questions or len(samples), len(samples))
    chosen = tuple(samples[row * len(samples) // count] for row in range(count))
    for name, got, least in (
        ("held-out questions", count, MIN_QUESTIONS),
        ("scenes of the held-out questions", count_scenes(chosen), MIN_SCENES),
    ):
        if got < least:
            fix = "With fewer, no relevant difference can be distinguished from chance."
            raise ConfigurationError(name, got=got, allowed=f"at least {least}", fix=fix)
    return chosen


def count_scenes(samples: Sequence[Sample]) -> int:
    """Number of scenes of `samples`, as the promotion gate counts them."""
    return len({scene_of(one.id, one.scene) for one in samples})


def samples_for_robot(samples: Sequence[Sample], robot: str) -> tuple[Sample, ...]:
    """The samples for `robot`: a data set may be for several robots."""
    return tuple(one for one in samples if msgspec.json.decode(one.contract, type=Contract).context.robot == robot)


def measure_planner(
    planner: LlamaPlanner,
    questions: Sequence[Sample],
    registry: SkillRegistry,
    *,
    adapter: str,
    runtime: str,
    execute: ExecuteContract | None = None,
    report: ReportResult = lambda done, of, trial: None,
) -> PlannerResults:
    """One unconstrained greedy answer per question, scored by the gate, the reference contract, and `execute`.

    A decline is compliant only if the reference contract declines. The gate checks bounds and names only, as in
    `make_gate_judge`: an answer that is rejected for geometry or robot counts as compliant, and as a failure of
    `execute`, which includes the complete gate. `report` receives number, total and result of each question. Raises
    `NoAnswerError`, and `ConfigurationError` from the runtime.
    """
    gate, trials = Gate(registry, {"planner": frozenset(registry.by_name)}), list[QuestionResult]()
    for number, sample in enumerate(questions, start=1):
        answer = complete(planner, sample.prompt, max_tokens=MAX_ANSWER_TOKENS)
        if isinstance(answer, ChatResponse):
            raise NoAnswerError(answer)
        trials.append(_measure_question(sample, answer, registry, gate, execute))
        report(number, len(questions), trials[-1])
    retained = perplexity(planner, retention_text())
    if isinstance(retained, ChatResponse):
        raise NoAnswerError(retained)
    return PlannerResults(adapter, runtime, retained, tuple(trials))


def _measure_question(
    sample: Sample, answer: RawCompletion, registry: SkillRegistry, gate: Gate, execute: ExecuteContract | None
) -> QuestionResult:
    def accepts(data: bytes) -> bool:
        return isinstance(gate.check(data, names=sample.scene_names, principal="planner", now=0.0), Accepted)

    found = score_answer(answer.text if answer.is_complete else "", sample.contract, registry, accepts)
    if execute is None:
        success, Delta = None, None
    else:
        success, Delta = execute(sample, answer.text) if found.compliant else (False, None)
    return QuestionResult(
        question=sample.id,
        scene=sample.scene,
        compliant=found.compliant,
        right=found.is_right,
        success=success,
        Delta=Delta,
    )
