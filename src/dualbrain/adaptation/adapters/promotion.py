"""The promotion gate: an adapter replaces the champion only if it was measured better, and in no measure much worse."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping

import msgspec
import numpy as np

from dualbrain.adaptation.adapters.scene_statistics import scene_interval, sign_flip_p
from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError

MIN_QUESTIONS = 30
"""Minimum number of questions: with fewer, no relevant difference can be distinguished from chance."""
MIN_SCENES = 10
"""Minimum number of scenes of the questions on which both planners have a measure, for it to justify a promotion.

Below eight scenes no difference can reach the corrected level.
"""
MAX_P = 0.05
"""Largest corrected p value of a significant improvement."""
MEASURE_AGAIN_HINT = "Measure again: `dualbrain adapters measure`."
EXECUTE_HINT = "measure with `dualbrain adapters measure`, without --no-fly"


class QuestionResult(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The result of one held-out question in the serving runtime: was the unconstrained answer compliant, and right?

    `success` and `Delta` (Δ of the execution) are None if the contract was not executed. `scene` is the scene or group
    of scenes of the question; "" in measurements of versions that did not record it: a scene of its own.
    """

    question: str
    scene: str = ""
    compliant: bool
    right: bool
    success: bool | None = None
    Delta: float | None = None


class PlannerResults(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All results of one planner: `adapter` by id ("" for the bare base), `runtime` by name and build.

    `perplexity` is measured on a fixed text that is unrelated to robots: it shows how much general language is
    retained.
    """

    adapter: str
    runtime: str
    perplexity: float
    trials: tuple[QuestionResult, ...]


class Measurement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The output of a measurement: both planners on the same questions, held out of the data set of this hash."""

    candidate: PlannerResults
    champion: PlannerResults
    dataset: str = ""


class Tolerances(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How much worse each measure may get: absolute for shares and Δ, relative for perplexity."""

    compliance: float = 0.02
    right: float = 0.02
    success: float = 0.02
    Delta: float = 0.0005
    perplexity: float = 0.05


class MeasureComparison(msgspec.Struct, frozen=True, kw_only=True):
    """One measure before and after. `gain` is positive if the candidate is better.

    `low` and `high` bound `gain` with 95 % confidence, and `p` is the two-sided p value of a gain of 0, corrected over
    all measures. They are None if questions of too few scenes have the measure; `p` also in decisions of versions that
    did not compute it.
    """

    before: float
    after: float
    gain: float
    low: float | None
    high: float | None
    tolerance: float
    p: float | None = None

    @property
    def is_worse(self) -> bool:
        """Whether the measure is worse than tolerated; NaN counts as worse."""
        return not self.gain >= -self.tolerance

    @property
    def is_better(self) -> bool:
        """Whether the improvement is significant: the interval is above 0, and p at most 5 %."""
        return self.low is not None and self.low > 0.0 and (self.p is None or self.p <= MAX_P)


class PromotionDecision(msgspec.Struct, frozen=True, kw_only=True):
    """Whether `candidate` may replace `champion`: all measures, and the reasons against a promotion.

    `dataset` is the hash of the data set that the questions are from, `runtime` the runtime of both planners. Either is
    "" in decisions of versions that did not record it.
    """

    candidate: str
    champion: str
    measures: dict[str, MeasureComparison]
    against: tuple[str, ...]
    dataset: str = ""
    runtime: str = ""

    @property
    def promotes(self) -> bool:
        """Whether there is no reason against the promotion."""
        return not self.against


MEASURES: Mapping[str, tuple[Callable[[QuestionResult], float], float]] = {
    "compliance": (lambda trial: float(trial.compliant), 1.0),
    "right": (lambda trial: float(trial.right), 1.0),
    "success": (lambda trial: math.nan if trial.success is None else float(trial.success), 1.0),
    "Delta": (lambda trial: trial.Delta if trial.success and trial.Delta is not None else math.nan, -1.0),
}
"""How each measure is read from a result, and the sign of its gain. Δ counts in successful executions only."""


def decide_promotion(
    candidate: PlannerResults,
    champion: PlannerResults,
    tolerances: Tolerances,
    rng: np.random.Generator,
    *,
    dataset: str = "",
) -> PromotionDecision:
    """Compare two planners question by question; the scene is the unit of all statistics (`scene_statistics`).

    Promise: the candidate is promoted only if at least one measure improves significantly (interval above 0, and p at
    most 5 % after correction over the measures) and no mean is worse than its tolerance. An equal candidate is
    therefore promoted with a probability of at most 5 %. Tolerances apply to the mean because the interval of some 30
    questions is wider than any useful tolerance: more questions make the gate finer. Success and Δ in closed loop are
    measures like the others, and a candidate without them is not promoted. Raises `ConfigurationError` for results that
    cannot be compared.
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
    against = [f"{name} got worse, from {m.before:.4g} to {m.after:.4g}" for name, m in measures.items() if m.is_worse]
    against += _too_few_scenes(pairs)
    against += _not_executed(candidate, champion) or _missing_delta(pairs)
    if not any(measure.is_better for measure in measures.values()):
        against.append("no measure is significantly better")
    return PromotionDecision(
        candidate=candidate.adapter,
        champion=champion.adapter,
        measures=measures,
        against=tuple(against),
        dataset=dataset,
        runtime=candidate.runtime,
    )


def scene_of(question: str, scene: str) -> str:
    """The unit of the statistics that a question belongs to: its scene, or without one the question itself."""
    return f"scene {scene}" if scene else f"question {question}"


def _too_few_scenes(pairs: list[tuple[QuestionResult, QuestionResult]]) -> list[str]:
    """Why the questions are too closely related, as reasons against a promotion."""
    count = len({scene_of(trial.question, trial.scene) for trial, _ in pairs})
    found = f"the questions are of {count_noun(count, 'scene')}, at least {MIN_SCENES} are needed"
    return [] if count >= MIN_SCENES else [found]


def _not_executed(candidate: PlannerResults, champion: PlannerResults) -> list[str]:
    """Which planner was not executed on every question, as reasons against a promotion."""
    both = (("candidate", candidate.trials), ("champion", champion.trials))
    lacking = [(who, sum(trial.success is None for trial in trials), len(trials)) for who, trials in both]
    return [
        f"the {who} was not executed on {left} of {count} questions: {EXECUTE_HINT}"
        for who, left, count in lacking
        if left
    ]


def _missing_delta(pairs: list[tuple[QuestionResult, QuestionResult]]) -> list[str]:
    """Why Δ cannot be compared, as reasons against a promotion.

    A champion without a single success has no Δ that could get worse: success alone decides then.
    """
    read, _ = MEASURES["Delta"]
    known = [tuple(not math.isnan(read(trial)) for trial in pair) for pair in pairs]
    alone = any(candidate for candidate, _ in known) and not any(champion.success for _, champion in pairs)
    compared = any(all(pair) for pair in known)
    return [] if compared or alone else ["Delta cannot be compared: no question was executed with success by both"]


def _paired_results(candidate: PlannerResults, champion: PlannerResults) -> list[tuple[QuestionResult, QuestionResult]]:
    of_champion = {trial.question: trial for trial in champion.trials}
    of_candidate = {trial.question: trial for trial in candidate.trials}
    same = len(of_candidate) == len(candidate.trials) == len(champion.trials) and {
        trial.question: trial.scene for trial in candidate.trials
    } == {trial.question: trial.scene for trial in champion.trials}
    if not same or candidate.runtime != champion.runtime:
        problem = "The results of the two planners cannot be compared: their questions, scenes or runtimes differ."
        raise ConfigurationError.stating(problem, fix=MEASURE_AGAIN_HINT)
    if len(of_candidate) < MIN_QUESTIONS:
        problem = f"The measurement has {len(of_candidate)} questions, but a comparison needs at least {MIN_QUESTIONS}."
        raise ConfigurationError.stating(problem, fix="Measure with more held-out questions.")
    if candidate.adapter == champion.adapter:
        raise ConfigurationError.stating("The candidate is the champion itself.", fix="Measure another adapter.")
    for results in (candidate, champion):
        _require_valid_numbers(results)
    return [(of_candidate[question], of_champion[question]) for question in sorted(of_candidate)]


def _require_valid_numbers(results: PlannerResults) -> None:
    """Raise `ConfigurationError` for a number that no measurement can give."""
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
    """One measure over the questions on which both planners have it; None if there is no such question."""
    values = np.array([(read(of_candidate), read(of_champion)) for of_candidate, of_champion in pairs])
    has_both = ~np.isnan(values).any(axis=1)
    if not has_both.any():
        return None
    gains = sign * (values[:, 0] - values[:, 1])
    by_scene: dict[str, list[float]] = defaultdict(list)
    for row in np.flatnonzero(has_both):
        trial = pairs[row][0]
        by_scene[scene_of(trial.question, trial.scene)].append(float(gains[row]))
    low = high = p = None
    if len(by_scene) >= MIN_SCENES:
        scenes = [np.array(one) for one in by_scene.values()]
        low, high = scene_interval(scenes, rng)
        p = min(1.0, len(MEASURES) * sign_flip_p(scenes, rng))
    after, before = map(float, values[has_both].mean(axis=0))
    gain = float(gains[has_both].mean())
    return MeasureComparison(before=before, after=after, gain=gain, low=low, high=high, tolerance=tolerance, p=p)
