"""The promotion gate: an adapter takes the place of another only if it was measured better, and nowhere much worse."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError

Array = NDArray[np.float64]
MIN_QUESTIONS = 30
"""Questions needed: with fewer, no difference that matters could be told from chance."""
MIN_PAIRED_QUESTIONS = 10
"""Of these, those on which both have a measure that is to earn a promotion: an interval of fewer is too narrow."""
N_RESAMPLES = 2000
MEASURE_AGAIN_HINT = "Measure again: `dualbrain adapters measure`."
EXECUTE_HINT = "measure with `dualbrain adapters measure`, without --no-fly"


class QuestionResult(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One held-out question: did the free answer comply, was it what was asked for, and how did the body fare with it.

    `success` and `Delta` are None where nothing was executed. Measured in the runtime that serves, not in torch.
    """

    question: str
    compliant: bool
    right: bool
    success: bool | None = None
    Delta: float | None = None


class PlannerResults(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All trials of one planner: `adapter` by id ("" the bare base), the `runtime` by name and build.

    `perplexity` is that on a fixed text of no robot's, the measure of what is retained.
    """

    adapter: str
    runtime: str
    perplexity: float
    trials: tuple[QuestionResult, ...]


class Measurement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a measurement leaves: both planners on the same questions, held out of the data set of this hash."""

    candidate: PlannerResults
    champion: PlannerResults
    dataset: str = ""


class Tolerances(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far each measure may fall: shares in points of 1, Δ absolutely, perplexity as a part of what it was."""

    compliance: float = 0.02
    right: float = 0.02
    success: float = 0.02
    Delta: float = 0.0005
    perplexity: float = 0.05


class MeasureComparison(msgspec.Struct, frozen=True, kw_only=True):
    """One measure before and after. `gain` is positive where the candidate is better.

    `low` and `high` bound it with 95 %; None where it was measured too rarely for that.
    """

    before: float
    after: float
    gain: float
    low: float | None
    high: float | None
    tolerance: float

    @property
    def is_worse(self) -> bool:
        """Worse than tolerated; what is no number has fallen."""
        return not self.gain >= -self.tolerance

    @property
    def is_better(self) -> bool:
        """Better beyond chance."""
        return self.low is not None and self.low > 0.0


class PromotionDecision(msgspec.Struct, frozen=True, kw_only=True):
    """Whether `candidate` may take the place of `champion`, every measure, and the reasons against it.

    `dataset` is the hash of the data set that the questions are of, `runtime` what both answered in; "" if that was not
    told, as in decisions of before it was kept.
    """

    candidate: str
    champion: str
    measures: dict[str, MeasureComparison]
    against: tuple[str, ...]
    dataset: str = ""
    runtime: str = ""

    @property
    def promotes(self) -> bool:
        """No reason against it."""
        return not self.against


MEASURES: Mapping[str, tuple[Callable[[QuestionResult], float], float]] = {
    "compliance": (lambda trial: float(trial.compliant), 1.0),
    "right": (lambda trial: float(trial.right), 1.0),
    "success": (lambda trial: math.nan if trial.success is None else float(trial.success), 1.0),
    "Delta": (lambda trial: trial.Delta if trial.success and trial.Delta is not None else math.nan, -1.0),
}
"""How each measure is read from a trial, and the sign of its gain. Δ of failures is not averaged with successes."""


def decide_promotion(
    candidate: PlannerResults,
    champion: PlannerResults,
    tolerances: Tolerances,
    rng: np.random.Generator,
    *,
    dataset: str = "",
) -> PromotionDecision:
    """Compare question by question (paired bootstrap of the mean difference, 95 %).

    Promise: it promotes only if at least one measure is better beyond chance (interval above 0) and none has fallen
    further than its tolerance. The second is judged by the mean, for the interval of some 30 questions is wider than
    any tolerance worth having: more questions make the gate finer. Success and Δ in closed loop are measures like the
    rest, and speak against the candidate where they are missing. Raises `InvalidSetup` for results that do not compare.
    """
    pairs = _paired_results(candidate, champion)
    measures = {
        name: compared
        for name, (read, sign) in MEASURES.items()
        if (compared := _compare_measure(pairs, read, sign, getattr(tolerances, name), rng)) is not None
    }
    ratio = math.log(champion.perplexity) - math.log(candidate.perplexity)
    allowed = math.log1p(tolerances.perplexity)
    kept = MeasureComparison(
        before=champion.perplexity, after=candidate.perplexity, gain=ratio, low=None, high=None, tolerance=allowed
    )
    measures["perplexity"] = kept
    against = [f"{name} fell from {m.before:.4g} to {m.after:.4g}" for name, m in measures.items() if m.is_worse]
    against += _not_executed(candidate, champion) or _missing_delta(pairs)
    if not any(measure.is_better for measure in measures.values()):
        against.append("nothing is better beyond chance")
    return PromotionDecision(
        candidate=candidate.adapter,
        champion=champion.adapter,
        measures=measures,
        against=tuple(against),
        dataset=dataset,
        runtime=candidate.runtime,
    )


def _not_executed(candidate: PlannerResults, champion: PlannerResults) -> list[str]:
    """Who was not flown on every question, in words."""
    both = (("candidate", candidate.trials), ("champion", champion.trials))
    lacking = [(who, sum(trial.success is None for trial in trials), len(trials)) for who, trials in both]
    return [
        f"the {who} was not flown on {left} of {count} questions: {EXECUTE_HINT}"
        for who, left, count in lacking
        if left
    ]


def _missing_delta(pairs: list[tuple[QuestionResult, QuestionResult]]) -> list[str]:
    """Why there is no Δ to compare, in words, none if there is one.

    A champion that brought nothing to the end has none that could be raised: there success alone tells.
    """
    read, _ = MEASURES["Delta"]
    known = [tuple(not math.isnan(read(trial)) for trial in pair) for pair in pairs]
    alone = any(ours for ours, _ in known) and not any(champion.success for _, champion in pairs)
    compared = any(all(pair) for pair in known)
    return [] if compared or alone else ["no Delta to compare: no question was brought to the end by both"]


def _paired_results(candidate: PlannerResults, champion: PlannerResults) -> list[tuple[QuestionResult, QuestionResult]]:
    theirs = {trial.question: trial for trial in champion.trials}
    ours = {trial.question: trial for trial in candidate.trials}
    same = ours.keys() == theirs.keys() and len(ours) == len(candidate.trials) == len(champion.trials)
    if not same or candidate.runtime != champion.runtime:
        raise ConfigurationError("results", got="other questions or another runtime", allowed="the same for both")
    if len(ours) < MIN_QUESTIONS:
        raise ConfigurationError("questions", got=len(ours), allowed=f"at least {MIN_QUESTIONS}")
    if candidate.adapter == champion.adapter:
        raise ConfigurationError("candidate", got="the champion itself", allowed="another adapter")
    for results in (candidate, champion):
        _require_valid_numbers(results)
    return [(ours[question], theirs[question]) for question in sorted(ours)]


def _require_valid_numbers(results: PlannerResults) -> None:
    """Raise `InvalidSetup` for a number that no measurement gives."""
    if not 1.0 <= results.perplexity < math.inf:
        raise ConfigurationError("perplexity", got=results.perplexity, allowed="1 or more", fix=MEASURE_AGAIN_HINT)
    for trial in results.trials:
        if trial.Delta is not None and not 0.0 <= trial.Delta < math.inf:
            raise ConfigurationError(
                f"Delta of question {trial.question}", got=trial.Delta, allowed="0 or more", fix=MEASURE_AGAIN_HINT
            )


def _compare_measure(
    pairs: list[tuple[QuestionResult, QuestionResult]],
    read: Callable[[QuestionResult], float],
    sign: float,
    tolerance: float,
    rng: np.random.Generator,
) -> MeasureComparison | None:
    """One measure over the questions on which both have it; None if there is no such question."""
    values = np.array([(read(ours), read(theirs)) for ours, theirs in pairs])
    both = values[~np.isnan(values).any(axis=1)]
    if not len(both):
        return None
    gains: Array = sign * (both[:, 0] - both[:, 1])
    means = gains[rng.integers(len(gains), size=(N_RESAMPLES, len(gains)))].mean(axis=1)
    low, high = map(float, np.percentile(means, [2.5, 97.5])) if len(both) >= MIN_PAIRED_QUESTIONS else (None, None)
    after, before = both.mean(axis=0)
    return MeasureComparison(
        before=float(before), after=float(after), gain=float(gains.mean()), low=low, high=high, tolerance=tolerance
    )
