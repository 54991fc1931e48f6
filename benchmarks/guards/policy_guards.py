"""The benchmark as a resumable experiment: python -m experiments policy_guards."""

from __future__ import annotations

from functools import cache
from typing import Any

from benchmarks.guards.episode import GUARDS, POLICIES, run_episode
from benchmarks.guards.scene import GuardScene, make_scene
from benchmarks.guards.tables import policy_section, summary
from experiments.engine.experiment import Options, Row, WorkUnit

N_SCENES = 250


class PolicyGuards:
    """The same policies in the same scenes, unguarded and behind every guard."""

    name = "policy_guards"
    intervals = "over scenes (bootstrap; Korn and Graubard for rare events), 95 %"
    claim = (
        "Behind dualbrain no link of the arm touches anything in at least 2,000 episodes of random, careless, learned "
        "and careful policies; success is at least 95 % of that of the unguarded policy where that was safe, and at "
        "least twice the safe successes of every other guard."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Scene by scene, every policy; one unit runs the policy behind all guards."""
        del options
        return [
            WorkUnit(f"{seed} {policy}", {"seed": seed, "policy": policy})
            for seed in range(N_SCENES)
            for policy in POLICIES
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One policy in one scene behind every guard."""
        scene = _open_scene(parameters["seed"])
        return {
            **parameters,
            "guards": {guard: run_episode(scene, parameters["policy"], guard) for guard in GUARDS},
        }

    def summarize_row(self, row: Row) -> str:
        """Contacts and successes by guard."""
        return ", ".join(
            f"{guard}: {'contact' if found['contact'] else found['reached'] or 'no contact'}"
            for guard, found in row["guards"].items()
        )

    def report(self, rows: list[Row]) -> list[str]:
        """One table for all policies, and one for each."""
        lines = summary(rows)
        for policy in POLICIES:
            some = [row for row in rows if row["policy"] == policy]
            lines += policy_section(policy, some) if some else []
        return lines


@cache
def _open_scene(seed: int) -> GuardScene:
    return make_scene(seed)
