"""Does the contract matter? At fixed speed, with a floor under Δ, failures ranked worst (design 8)."""

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
"""Families of level II: in those of level I an arm that looks ahead succeeds with nearly every contract."""
FLOOR = 1e-4
"""Δ below this counts as this: a ratio to zero says nothing."""
FAILED = float("inf")
RATIO, SPEARMAN = 3.0, 0.5

Scores = dict[int, dict[str, float]]
"""By seed and contract: max(Δ, floor) of a success, infinity for a failure."""


def families(rows: Iterable[Row]) -> dict[tuple[str, float], Scores]:
    """The scores by (family, speed); contracts that the gate refused are left out."""
    tables: dict[tuple[str, float], Scores] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        if row.get("valid") and not row.get("again"):
            values = row["parameters"]
            contract = " ".join(str(value) for name, value in values.items() if name != "speed")
            score = max(row["Delta"], FLOOR) if succeeded(row) else FAILED
            tables[row["family"], values["speed"]][row["seed"]][contract] = score
    return {key: {seed: dict(line) for seed, line in sorted(scores.items())} for key, scores in tables.items()}


def ratios(scores: Scores) -> list[float]:
    """Worst over best Δ among the successes of each seed that has at least two."""
    good = [[value for value in line.values() if value < FAILED] for line in scores.values()]
    return [max(values) / min(values) for values in good if len(values) > 1]


def repeats(rows: Iterable[Row]) -> dict[tuple[str, float], list[float]]:
    """By (family, speed): rank correlation of the contracts in one scene between two seeds of the perception's noise.

    The same scene must rank its contracts alike, else Δ would be luck; different scenes need not (see `regret`).
    """
    rows = [row for row in rows if row.get("valid")]
    pairs: dict[tuple[str, float], list[float]] = defaultdict(list)
    for family, speed, seed in sorted(
        {(r["family"], r["parameters"]["speed"], r["seed"]) for r in rows if r.get("again")}
    ):
        here = [r for r in rows if (r["family"], r["parameters"]["speed"], r["seed"]) == (family, speed, seed)]
        once = families([r for r in here if not r.get("again")]).get((family, speed), {})
        twice = families([{**r, "again": False} for r in here if r.get("again")])[family, speed]
        if seed in once:
            pairs[family, speed] += spearmans({0: once[seed], 1: twice[seed]})
    return pairs


def spearmans(scores: Scores) -> list[float]:
    """Rank correlation between each two lines over their common contracts; a constant line says nothing."""
    found: list[float] = []
    for first, second in combinations(scores.values(), 2):
        common = sorted(first.keys() & second.keys())
        if len({first[name] for name in common}) > 1 and len({second[name] for name in common}) > 1:
            found.append(_correlation([first[name] for name in common], [second[name] for name in common]))
    return found


def _correlation(first: list[float], second: list[float]) -> float:
    """Pearson's r of the average ranks."""
    x, y = rankdata(first), rankdata(second)
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / ((x @ x) * (y @ y)) ** 0.5)


def regret(scores: Scores) -> tuple[str, float, float]:
    """(best fixed contract, share of feasible seeds it fails, mean extra Δ over the seed's best where it succeeds).

    The best fixed contract succeeds on most seeds, then has the least mean Δ there.
    """
    feasible = {seed: line for seed, line in scores.items() if min(line.values()) < FAILED}
    if not feasible:
        return "", 0.0, 0.0
    contracts = set.intersection(*(set(line) for line in feasible.values()))

    def merit(name: str) -> tuple[int, float, str]:
        values = [line[name] for line in feasible.values() if line[name] < FAILED]
        return -len(values), mean(values) if values else FAILED, name

    best = min(contracts, key=merit)
    where = [line for line in feasible.values() if line[best] < FAILED]
    extra = mean(line[best] - min(line.values()) for line in where) if where else 0.0
    return best, 1.0 - len(where) / len(feasible), extra


@dataclass(frozen=True, slots=True)
class Learnable:
    """The four parts of the bar for one family at one speed."""

    family: str
    speed: float
    seeds: int
    contracts: int
    episodes: int
    successes: int
    ratios: list[float]
    across: list[float]
    spearmans: list[float]
    best_fixed: str
    regret_success: float
    regret_delta: float
    decline: list[int]
    """Seeds whose scene no contract of the grid solves: a planner should decline there."""

    @property
    def parts(self) -> dict[str, bool]:
        """Each part of the bar."""
        return {
            "threefold": bool(self.ratios) and median(self.ratios) >= RATIO,
            "repeats": bool(self.spearmans) and median(self.spearmans) >= SPEARMAN,
            "success varies": 0 < self.successes < self.episodes,
            "regret": self.regret_success > 0.0 or self.regret_delta > 0.0,
        }

    @property
    def decline_words(self) -> str:
        """Which scenes are to be declined."""
        return ", ".join(f"{self.family}:{seed}" for seed in self.decline) or "none"

    @property
    def words(self) -> str:
        """Met, or which parts are not."""
        missed = [name for name, met in self.parts.items() if not met]
        return "missed: " + ", ".join(missed) if missed else "met"

    @property
    def ratio_words(self) -> str:
        """Median over seeds, then the range."""
        return _spread(self.ratios, "{:.1f}")

    @property
    def rank_words(self) -> str:
        """In one scene under other noise, median and range."""
        return _spread(self.spearmans, "{:.2f}")

    @property
    def across_words(self) -> str:
        """Between different scenes of the family, median and range; no part of the bar."""
        return _spread(self.across, "{:.2f}")

    @property
    def regret_words(self) -> str:
        """In success and in Δ, and whose."""
        if not self.best_fixed:
            return "no contract succeeds"
        return f"{self.regret_success:.0%} of feasible seeds failed, Δ +{self.regret_delta:.4f} ({self.best_fixed})"


def _spread(values: list[float], form: str) -> str:
    if not values:
        return "undefined"
    low, middle, high = (form.format(value) for value in (min(values), median(values), max(values)))
    return f"{middle} ({low}–{high}, n={len(values)})"


def verdicts(rows: Iterable[Row], order: Sequence[str] = FAMILIES) -> list[Learnable]:
    """One verdict a family and speed, families in `order`."""
    rows = list(rows)
    found: list[Learnable] = []
    tables, again = families(rows), repeats(rows)
    for family, speed in sorted(tables, key=lambda key: (order.index(key[0]), key[1])):
        scores = tables[family, speed]
        values = [value for line in scores.values() for value in line.values()]
        good = sum(value < FAILED for value in values)
        contracts = len({name for line in scores.values() for name in line})
        lost = [seed for seed, line in scores.items() if min(line.values()) == FAILED]
        figures = (ratios(scores), spearmans(scores), again.get((family, speed), []), *regret(scores))
        found.append(Learnable(family, speed, len(scores), contracts, len(values), good, *figures, lost))
    return found
