"""Sensitivity of the outcome to the contract: at fixed speed, with a lower bound on Δ, failures ranked last."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import mean, median

from scipy.stats import rankdata

from experiments.engine.experiment import Row
from experiments.safety.closed_loop import succeeded

FAMILIES = ("tall_ii", "shelf_ii", "forearm_ii")
"""Families of level II; in those of level I, an arm with clearance prediction succeeds with nearly every contract."""
DELTA_FLOOR = 1e-4
"""Lower bound of Δ, because a ratio to zero is meaningless."""
FAILURE_SCORE = float("inf")
MIN_DELTA_RATIO, MIN_SPEARMAN = 3.0, 0.5

ScoresBySeed = dict[int, dict[str, float]]
"""By seed and contract: max(Δ, `DELTA_FLOOR`) of a success, infinity for a failure."""


def scores_by_family(rows: Iterable[Row]) -> dict[tuple[str, float], ScoresBySeed]:
    """The scores by (family, speed), without contracts that the gate rejected."""
    tables: dict[tuple[str, float], ScoresBySeed] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        if row.get("valid") and not row.get("again"):
            values = row["parameters"]
            contract = " ".join(str(value) for name, value in values.items() if name != "speed")
            score = max(row["Delta"], DELTA_FLOOR) if succeeded(row) else FAILURE_SCORE
            tables[row["family"], values["speed"]][row["seed"]][contract] = score
    return {key: {seed: dict(line) for seed, line in sorted(scores.items())} for key, scores in tables.items()}


def delta_ratios(scores: ScoresBySeed) -> list[float]:
    """The ratio of the worst to the best Δ among the successes of each seed with at least two."""
    good = [[value for value in line.values() if value < FAILURE_SCORE] for line in scores.values()]
    return [max(values) / min(values) for values in good if len(values) > 1]


def noise_rank_correlations(rows: Iterable[Row]) -> dict[tuple[str, float], list[float]]:
    """By (family, speed): rank correlation of the contracts in one scene between two seeds of the perception noise.

    In the same scene the ranking must repeat, otherwise Δ would be chance; different scenes may rank differently (see
    `best_fixed_regret`).
    """
    rows = [row for row in rows if row.get("valid")]
    pairs: dict[tuple[str, float], list[float]] = defaultdict(list)
    for family, speed, seed in sorted(
        {(r["family"], r["parameters"]["speed"], r["seed"]) for r in rows if r.get("again")}
    ):
        here = [r for r in rows if (r["family"], r["parameters"]["speed"], r["seed"]) == (family, speed, seed)]
        first = scores_by_family([r for r in here if not r.get("again")]).get((family, speed), {})
        repeated = scores_by_family([{**r, "again": False} for r in here if r.get("again")])[family, speed]
        if seed in first:
            pairs[family, speed] += rank_correlations({0: first[seed], 1: repeated[seed]})
    return pairs


def rank_correlations(scores: ScoresBySeed) -> list[float]:
    """Rank correlations between any two seeds over their common contracts, without constant scores."""
    found: list[float] = []
    for first, second in combinations(scores.values(), 2):
        common = sorted(first.keys() & second.keys())
        if len({first[name] for name in common}) > 1 and len({second[name] for name in common}) > 1:
            found.append(_spearman([first[name] for name in common], [second[name] for name in common]))
    return found


def _spearman(first: list[float], second: list[float]) -> float:
    """Pearson's r of the average ranks."""
    x, y = rankdata(first), rankdata(second)
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / ((x @ x) * (y @ y)) ** 0.5)


def best_fixed_regret(scores: ScoresBySeed) -> tuple[str, float, float]:
    """(best fixed contract, share of feasible seeds on which it fails, mean excess Δ over the seed's best contract).

    The best fixed contract succeeds on the most seeds and, among those, has the smallest mean Δ.
    """
    feasible = {seed: line for seed, line in scores.items() if min(line.values()) < FAILURE_SCORE}
    if not feasible:
        return "", 0.0, 0.0
    contracts = set.intersection(*(set(line) for line in feasible.values()))

    def merit(name: str) -> tuple[int, float, str]:
        values = [line[name] for line in feasible.values() if line[name] < FAILURE_SCORE]
        return -len(values), mean(values) if values else FAILURE_SCORE, name

    best = min(contracts, key=merit)
    where = [line for line in feasible.values() if line[best] < FAILURE_SCORE]
    extra = mean(line[best] - min(line.values()) for line in where) if where else 0.0
    return best, 1.0 - len(where) / len(feasible), extra


@dataclass(frozen=True, slots=True, kw_only=True)
class SensitivityResult:
    """The quantities of the four criteria for one family at one speed."""

    family: str
    speed: float
    seeds: int
    contracts: int
    episodes: int
    successes: int
    ratios: list[float]
    cross_scene_correlations: list[float]
    noise_correlations: list[float]
    best_fixed: str
    regret_success: float
    regret_delta: float
    unsolved_seeds: list[int]
    """Seeds whose scene no contract of the grid solves; a planner should decline there."""

    @property
    def criteria(self) -> dict[str, bool]:
        """The four criteria, and whether each is met."""
        return {
            "threefold": bool(self.ratios) and median(self.ratios) >= MIN_DELTA_RATIO,
            "repeats": bool(self.noise_correlations) and median(self.noise_correlations) >= MIN_SPEARMAN,
            "success varies": 0 < self.successes < self.episodes,
            "regret": self.regret_success > 0.0 or self.regret_delta > 0.0,
        }

    @property
    def unsolved_text(self) -> str:
        """The scenes that no contract solves."""
        return ", ".join(f"{self.family}:{seed}" for seed in self.unsolved_seeds) or "none"

    @property
    def verdict_text(self) -> str:
        """The text met, or the criteria that are not met."""
        missed = [name for name, met in self.criteria.items() if not met]
        return "missed: " + ", ".join(missed) if missed else "met"

    @property
    def ratio_text(self) -> str:
        """Ratios of Δ: median over seeds and range."""
        return _format_range(self.ratios, "{:.1f}")

    @property
    def noise_text(self) -> str:
        """Rank correlations in one scene under other noise: median and range."""
        return _format_range(self.noise_correlations, "{:.2f}")

    @property
    def cross_scene_text(self) -> str:
        """Rank correlations between different scenes of the family: median and range; no criterion."""
        return _format_range(self.cross_scene_correlations, "{:.2f}")

    @property
    def regret_text(self) -> str:
        """Regret in success and in Δ, and the best fixed contract."""
        if not self.best_fixed:
            return "no contract succeeds"
        return f"{self.regret_success:.0%} of feasible seeds failed, Δ +{self.regret_delta:.4f} ({self.best_fixed})"


def _format_range(values: list[float], form: str) -> str:
    if not values:
        return "undefined"
    low, middle, high = (form.format(value) for value in (min(values), median(values), max(values)))
    return f"{middle} ({low}–{high}, n={len(values)})"


def evaluate_sensitivity(rows: Iterable[Row], order: Sequence[str] = FAMILIES) -> list[SensitivityResult]:
    """One result per family and speed, families in `order`."""
    rows = list(rows)
    found: list[SensitivityResult] = []
    tables, again = scores_by_family(rows), noise_rank_correlations(rows)
    for family, speed in sorted(tables, key=lambda key: (order.index(key[0]), key[1])):
        scores = tables[family, speed]
        values = [value for line in scores.values() for value in line.values()]
        good = sum(value < FAILURE_SCORE for value in values)
        contracts = len({name for line in scores.values() for name in line})
        unsolved = [seed for seed, line in scores.items() if min(line.values()) == FAILURE_SCORE]
        best, regret_success, regret_delta = best_fixed_regret(scores)
        found.append(
            SensitivityResult(
                family=family,
                speed=speed,
                seeds=len(scores),
                contracts=contracts,
                episodes=len(values),
                successes=good,
                ratios=delta_ratios(scores),
                cross_scene_correlations=rank_correlations(scores),
                noise_correlations=again.get((family, speed), []),
                best_fixed=best,
                regret_success=regret_success,
                regret_delta=regret_delta,
                unsolved_seeds=unsolved,
            )
        )
    return found
