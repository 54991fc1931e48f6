"""Choice of the contract: random, one for all places, or the value model by the symbols of the scene (in the twin)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from dualbrain.adaptation.synthetic.split import TEST_PART, TRAINING_PART, Split
from dualbrain.adaptation.value_model.value_model import best_fixed_alternative, fit_value_model
from dualbrain.evaluation.analysis.statistics import compare, difference, estimate
from dualbrain.grounding.alternatives import DEFAULT_ALTERNATIVE
from dualbrain.runtime.data_collection.exploration.explore import nth_place
from dualbrain.runtime.data_collection.exploration.trial import Trial, execute_siblings, group_siblings
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table

N_EXPLORED, N_HELD_OUT = 120, 96
SEEDS: Mapping[Split, int] = {TRAINING_PART: 1, TEST_PART: 302}
"""Seeds of the explored and of the held-out places."""
EPSILON = 0.0021
CURVE = (5, 10, 20, 40, 80, 120)
"""Numbers of explored places in the curve."""
N_DRAWS = 20
"""Random choices of the explored places at each point of the curve."""

Choice = Callable[[str, Mapping[str, Trial]], str]
"""Chooses an alternative by the name of the place and the executed siblings there."""


class NamedAlternatives:
    """All alternatives at explored and at held-out places, in the kinematic twin."""

    name = "named_alternatives"
    claim = (
        "A ridge regression on the symbols of the scene, fitted on siblings that were executed at other places, "
        "chooses better contracts than the best fixed one."
    )
    intervals = "95 %, bootstrap over places"

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit per place."""
        counts: dict[Split, int] = {TRAINING_PART: N_EXPLORED, TEST_PART: N_HELD_OUT}
        return [
            WorkUnit(f"{part}/{index}", {"part": part, "index": index})
            for part, count in counts.items()
            for index in range(count)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Execute all alternatives at one place."""
        part = parameters["part"]
        place = nth_place("panda", part, SEEDS[part], parameters["index"])
        return {"trials": msgspec.to_builtins(execute_siblings(place, list(place.contracts())))}

    def summarize_row(self, row: Row) -> str:
        """Scene and number of successes."""
        trials = row["trials"]
        return f"{trials[0]['scene']}: {sum(one['kind'] == 'succeeded' for one in trials)} of {len(trials)} succeed"

    def report(self, rows: list[Row]) -> list[str]:
        """Success, clean share, intervention and time by who chooses, and the curve over explored places."""
        explored, held_out = (_places(rows, part) for part in (TRAINING_PART, TEST_PART))
        model = fit_value_model(group_siblings(t for place in explored for t in place.values()))
        fixed = best_fixed_alternative(group_siblings(t for place in explored for t in place.values()))
        rng = np.random.default_rng(0)
        choices: dict[str, Choice] = {
            "a random alternative": lambda name, place: str(rng.choice(list(place))),
            f"`{DEFAULT_ALTERNATIVE}` everywhere": lambda name, place: DEFAULT_ALTERNATIVE,
            f"the best fixed one, `{fixed}`": lambda name, place: fixed if fixed in place else DEFAULT_ALTERNATIVE,
            "the value model": lambda name, place: model.choose(_placement(place), list(place), DEFAULT_ALTERNATIVE),
            "the best sibling in hindsight": lambda name, place: max(place, key=lambda one: place[one].utility),
        }
        chosen = {
            who: [place[choice(str(i), place)] for i, place in enumerate(held_out)] for who, choice in choices.items()
        }
        lines = _table(chosen)
        best, ours = (_utilities(chosen[who]) for who in (f"the best fixed one, `{fixed}`", "the value model"))
        found = compare(ours, best, difference)
        lines += [
            "",
            "Utility of the value model minus that of the best fixed alternative, paired by place: "
            f"{found.effect:+.3f} [{found.low:+.3f}, {found.high:+.3f}].",
            "",
            "Utility at the held-out places after a number of explored places, mean over "
            f"{N_DRAWS} random choices of these:",
            "",
            *_curve(explored, held_out),
        ]
        return lines


def _places(rows: Sequence[Row], part: Split) -> list[dict[str, Trial]]:
    """The executed siblings of each place by alternative."""
    found = [msgspec.convert(row["trials"], tuple[Trial, ...]) for row in rows if row["key"].startswith(f"{part}/")]
    return [{one.alternative: one for one in trials} for trials in found]


def _placement(place: Mapping[str, Trial]) -> Any:
    return group_siblings(list(place.values())[:1])[0].placement


def _utilities(trials: Sequence[Trial]) -> dict[str, list[float]]:
    return {str(index): [one.utility] for index, one in enumerate(trials)}


def _table(chosen: Mapping[str, Sequence[Trial]]) -> list[str]:
    rows: list[tuple[str, ...]] = []
    for who, trials in chosen.items():
        success = {str(i): [float(one.kind == "succeeded")] for i, one in enumerate(trials)}
        clean = {str(i): [float(_is_clean(one))] for i, one in enumerate(trials)}
        ticks = {str(i): [one.intervention_frequency] for i, one in enumerate(trials)}
        seconds = [one.duration for one in trials if one.kind == "succeeded"]
        rows.append(
            (
                who,
                _share(success, is_rate=True),
                _share(clean, is_rate=True),
                _share(ticks, is_rate=False),
                f"{np.mean(seconds):.1f}",
                f"{np.mean([one.utility for one in trials]):.3f}",
                str(len({one.alternative for one in trials})),
            )
        )
    headers = (
        "who chooses",
        "success",
        "clean",
        "intervened ticks",
        "time of successes [s]",
        "utility",
        "alternatives",
    )
    return markdown_table(headers, rows)


def _share(values: dict[str, list[float]], *, is_rate: bool) -> str:
    found = estimate(values, is_rate=is_rate)
    return f"{found.mean:.1%} [{max(found.low, 0.0):.1%}, {min(found.high, 1.0):.1%}]"


def _is_clean(one: Trial) -> bool:
    return one.kind == "succeeded" and (one.Delta or 0.0) <= EPSILON


def _curve(explored: Sequence[dict[str, Trial]], held_out: Sequence[dict[str, Trial]]) -> list[str]:
    """Mean utility of the value model and of the best fixed alternative by the number of explored places."""
    rng = np.random.default_rng(1)
    rows: list[tuple[str, ...]] = []
    for count in (n for n in CURVE if n <= len(explored)):
        model_utilities, fixed_utilities, executions = list[float](), list[float](), 0
        for _ in range(N_DRAWS if count < len(explored) else 1):
            some = [explored[int(i)] for i in rng.choice(len(explored), count, replace=False)]
            siblings = group_siblings(t for place in some for t in place.values())
            executions = sum(len(place) for place in some)
            model, fixed = fit_value_model(siblings), best_fixed_alternative(siblings)
            for place in held_out:
                name = model.choose(_placement(place), list(place), DEFAULT_ALTERNATIVE)
                model_utilities.append(place[name].utility)
                fixed_utilities.append(place[fixed if fixed in place else DEFAULT_ALTERNATIVE].utility)
        rows.append((str(count), str(executions), f"{np.mean(model_utilities):.3f}", f"{np.mean(fixed_utilities):.3f}"))
    return markdown_table(("explored places", "executions", "value model", "best fixed alternative"), rows)
