"""Key numbers of an episode, formatted the same way in the live view and in the report."""

from __future__ import annotations

from dataclasses import dataclass

from dualbrain.records import Episode


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyNumber:
    """A number: `name` as in `episode.json`, a `label` for people, its `value`, and its `text` with `unit`."""

    name: str
    label: str
    value: float | str | None
    text: str
    unit: str = ""


def format_millimetres(metres: float | None) -> str:
    """A length [m] as text in millimetres; a dash for None."""
    return "–" if metres is None else f"{1e3 * metres:.2f}".replace("-", "−")


def format_seconds(value: float | None) -> str:
    """A time [s] as text; a dash for None."""
    return "–" if value is None else f"{value:.2f}"


def format_dimensionless(value: float | None) -> str:
    """An intervention magnitude (0 to 2) as text; a dash for None."""
    return "–" if value is None else f"{value:.5f}"


def key_numbers(episode: Episode) -> tuple[KeyNumber, ...]:
    """Δ, intervention frequency, h_min, duration, planner time and violations; a dash for values not measured."""
    outcome, judgement = episode.outcome, episode.judgement
    ran = outcome.Delta is not None
    planner = sum(sum(attempt.proposal.timings.values()) for attempt in episode.attempts)
    planner = episode.timings.get("planner", planner)
    violations = None if judgement is None else len(judgement.violations)
    frequency = outcome.intervention_frequency if ran else None
    return (
        KeyNumber(name="Delta", label="Δ, mean of δ", value=outcome.Delta, text=format_dimensionless(outcome.Delta)),
        KeyNumber(
            name="delta_peak",
            label="δ, peak",
            value=outcome.delta_peak if ran else None,
            text=format_dimensionless(outcome.delta_peak if ran else None),
        ),
        KeyNumber(
            name="intervention_frequency",
            label="ticks intervened",
            value=frequency,
            text="–" if frequency is None else f"{100 * frequency:.2f}",
            unit="%",
        ),
        KeyNumber(
            name="h_min",
            label="least clearance",
            value=outcome.h_min,
            text=format_millimetres(outcome.h_min),
            unit="mm",
        ),
        KeyNumber(
            name="duration", label="duration", value=outcome.duration, text=format_seconds(outcome.duration), unit="s"
        ),
        KeyNumber(name="planner", label="planner", value=planner, text=format_seconds(planner), unit="s"),
        KeyNumber(
            name="violations", label="violations", value=violations, text="–" if violations is None else str(violations)
        ),
    )
