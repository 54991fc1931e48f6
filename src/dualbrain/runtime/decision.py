"""How long a decision took, broken down: retrieval, prefill, decoding, validation (paper 7.3, latency)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dualbrain.records import Attempt

PARTS = {
    "retrieval": "retrieval", "planner_load": "load of the model", "planner_prefill": "prefill",
    "planner_decode": "decoding", "planner_rest": "rest of the planner", "gate": "validation",
}  # fmt: skip
"""The parts of a decision by their keys in the timings of an episode, with their words, in their order."""


def timings(attempts: Sequence[Attempt], retrieval: float) -> dict[str, float]:
    """Times of a decision [s], added up over its shots.

    decision = retrieval + planner + gate; planner = load + prefill + decode + rest, as far as the planner tells them
    (`planner_load`, …); without being told anything, the whole of it is rest. In lockstep no time passes for the robot.
    """
    told = [attempt.proposal.timings for attempt in attempts]
    names = dict.fromkeys(name for one in told for name in one if name != "total" and not name.endswith("_tokens"))
    parts = {f"planner_{name}": sum(one.get(name, 0.0) for one in told) for name in names}
    planner, gate = sum(one.get("total", 0.0) for one in told), sum(attempt.gate_s for attempt in attempts)
    parts["planner_rest"] = max(0.0, planner - sum(parts.values()))
    return {"retrieval": retrieval, "planner": planner, **parts, "gate": gate, "decision": retrieval + planner + gate}


def breakdown(spent: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """The parts of a decision in words with their times [s], those that were measured, in their order."""
    return tuple((words, spent[name]) for name, words in PARTS.items() if name in spent)


def in_words(spent: Mapping[str, float]) -> str:
    """One line for people: "decided in 12.3 s: retrieval 0.04 s, prefill 4.1 s, …"; "" if nothing was decided."""
    parts = ", ".join(f"{words} {_seconds(value)}" for words, value in breakdown(spent) if value > 0.0)
    return f"decided in {_seconds(spent['decision'])}: {parts}" if parts and "decision" in spent else ""


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 0.1 else f"{value * 1e3:.1f} ms"
