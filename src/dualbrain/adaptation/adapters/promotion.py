"""The promotion gate: an adapter takes the place of another only if it was measured better, and nowhere much worse."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup

Values = NDArray[np.float64]
LEAST = 30
"""Questions needed: with fewer, no difference that matters could be told from chance."""
LEAST_PAIRED = 10
"""Of these, those on which both have a measure that is to earn a promotion: an interval of fewer is too narrow."""
RESAMPLES = 2000
AGAIN = "Measure again: `dualbrain adapters measure`."
FLY = "measure with `dualbrain adapters measure`, without --no-fly"


class Trial(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One held-out question: did the free answer comply, was it what was asked for, and how did the body fare with it.

    `success` and `Delta` are None where nothing was executed. Measured in the runtime that serves, not in torch.
    """

    question: str
    compliant: bool
    right: bool
    success: bool | None = None
    Delta: float | None = None


class Results(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All trials of one planner: `adapter` by id ("" the bare base), the `runtime` by name and build.

    `perplexity` is that on a fixed text of no robot's, the measure of what is retained.
    """

    adapter: str
    runtime: str
    perplexity: float
    trials: tuple[Trial, ...]


class Measured(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a measurement leaves: both planners on the same questions, held out of the data set of this hash."""

    candidate: Results
    champion: Results
    dataset: str = ""


class Tolerances(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far each measure may fall: shares in points of 1, Δ absolutely, perplexity as a part of what it was."""

    compliance: float = 0.02
    right: float = 0.02
    success: float = 0.02
    Delta: float = 0.0005
    perplexity: float = 0.05


class Compared(msgspec.Struct, frozen=True):
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
    def fallen(self) -> bool:
        """Worse than tolerated; what is no number has fallen."""
        return not self.gain >= -self.tolerance

    @property
    def better(self) -> bool:
        """Better beyond chance."""
        return self.low is not None and self.low > 0.0


class Decision(msgspec.Struct, frozen=True):
    """Whether `candidate` may take the place of `champion`, every measure, and the reasons against it.

    `dataset` is the hash of the data set that the questions are of, `runtime` what both answered in; "" if that was not
    told, as in decisions of before it was kept.
    """

    candidate: str
    champion: str
    measures: dict[str, Compared]
    against: tuple[str, ...]
    dataset: str = ""
    runtime: str = ""

    @property
    def promotes(self) -> bool:
        """No reason against it."""
        return not self.against


MEASURES: Mapping[str, tuple[Callable[[Trial], float], float]] = {
    "compliance": (lambda trial: float(trial.compliant), 1.0),
    "right": (lambda trial: float(trial.right), 1.0),
    "success": (lambda trial: math.nan if trial.success is None else float(trial.success), 1.0),
    "Delta": (lambda trial: trial.Delta if trial.success and trial.Delta is not None else math.nan, -1.0),
}
"""How each measure is read from a trial, and the sign of its gain. Δ of failures is not averaged with successes."""


def decide(
    candidate: Results, champion: Results, tolerances: Tolerances, rng: np.random.Generator, *, dataset: str = ""
) -> Decision:
    """Compare question by question (paired bootstrap of the mean difference, 95 %).

    Promise: it promotes only if at least one measure is better beyond chance (interval above 0) and none has fallen
    further than its tolerance. The second is judged by the mean, for the interval of some 30 questions is wider than
    any tolerance worth having: more questions make the gate finer. Success and Δ in closed loop are measures like the
    rest, and speak against the candidate where they are missing. Raises `InvalidSetup` for results that do not compare.
    """
    pairs = _pairs(candidate, champion)
    measures = {
        name: compared
        for name, (read, sign) in MEASURES.items()
        if (compared := _compare(pairs, read, sign, getattr(tolerances, name), rng)) is not None
    }
    ratio = math.log(champion.perplexity) - math.log(candidate.perplexity)
    allowed = math.log1p(tolerances.perplexity)
    kept = Compared(champion.perplexity, candidate.perplexity, ratio, None, None, allowed)
    measures["perplexity"] = kept
    against = [f"{name} fell from {m.before:.4g} to {m.after:.4g}" for name, m in measures.items() if m.fallen]
    against += _not_flown(candidate, champion) or _without_delta(pairs)
    if not any(measure.better for measure in measures.values()):
        against.append("nothing is better beyond chance")
    return Decision(candidate.adapter, champion.adapter, measures, tuple(against), dataset, candidate.runtime)


def _not_flown(candidate: Results, champion: Results) -> list[str]:
    """Who was not flown on every question, in words."""
    both = (("candidate", candidate.trials), ("champion", champion.trials))
    lacking = [(who, sum(trial.success is None for trial in trials), len(trials)) for who, trials in both]
    return [f"the {who} was not flown on {left} of {count} questions: {FLY}" for who, left, count in lacking if left]


def _without_delta(pairs: list[tuple[Trial, Trial]]) -> list[str]:
    """Why there is no Δ to compare, in words, none if there is one.

    A champion that brought nothing to the end has none that could be raised: there success alone tells.
    """
    read, _ = MEASURES["Delta"]
    known = [tuple(not math.isnan(read(trial)) for trial in pair) for pair in pairs]
    alone = any(ours for ours, _ in known) and not any(champion.success for _, champion in pairs)
    compared = any(all(pair) for pair in known)
    return [] if compared or alone else ["no Delta to compare: no question was brought to the end by both"]


def _pairs(candidate: Results, champion: Results) -> list[tuple[Trial, Trial]]:
    theirs = {trial.question: trial for trial in champion.trials}
    ours = {trial.question: trial for trial in candidate.trials}
    same = ours.keys() == theirs.keys() and len(ours) == len(candidate.trials) == len(champion.trials)
    if not same or candidate.runtime != champion.runtime:
        raise InvalidSetup("results", got="other questions or another runtime", allowed="the same for both")
    if len(ours) < LEAST:
        raise InvalidSetup("questions", got=len(ours), allowed=f"at least {LEAST}")
    if candidate.adapter == champion.adapter:
        raise InvalidSetup("candidate", got="the champion itself", allowed="another adapter")
    for results in (candidate, champion):
        _require_possible(results)
    return [(ours[question], theirs[question]) for question in sorted(ours)]


def _require_possible(results: Results) -> None:
    """Raise `InvalidSetup` for a number that no measurement gives."""
    if not 1.0 <= results.perplexity < math.inf:
        raise InvalidSetup("perplexity", got=results.perplexity, allowed="1 or more", fix=AGAIN)
    for trial in results.trials:
        if trial.Delta is not None and not 0.0 <= trial.Delta < math.inf:
            raise InvalidSetup(f"Delta of question {trial.question}", got=trial.Delta, allowed="0 or more", fix=AGAIN)


def _compare(
    pairs: list[tuple[Trial, Trial]], read: Callable[[Trial], float], sign: float, tolerance: float,
    rng: np.random.Generator,
) -> Compared | None:  # fmt: skip
    """One measure over the questions on which both have it; None if there is no such question."""
    values = np.array([(read(ours), read(theirs)) for ours, theirs in pairs])
    both = values[~np.isnan(values).any(axis=1)]
    if not len(both):
        return None
    gains: Values = sign * (both[:, 0] - both[:, 1])
    means = gains[rng.integers(len(gains), size=(RESAMPLES, len(gains)))].mean(axis=1)
    low, high = map(float, np.percentile(means, [2.5, 97.5])) if len(both) >= LEAST_PAIRED else (None, None)
    after, before = both.mean(axis=0)
    return Compared(float(before), float(after), float(gains.mean()), low, high, tolerance)
