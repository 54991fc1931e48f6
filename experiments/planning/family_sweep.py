"""The criteria of the sensitivity sweep for objects that must not fall or break, and for the mobile base."""

from __future__ import annotations

from itertools import product
from typing import Any

from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.families import TASK_FAMILIES as TASKS
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.planning.sensitivity_sweep import NOISE_SEED_OFFSET, sensitivity_tables
from experiments.safety.closed_loop import describe_outcome, pick_and_place_actions, run_contract, run_row

SEEDS = ((0, False), (0, True), (1, False), (2, False), (1, True), (2, True), *((seed, False) for seed in range(3, 6)))
"""Seeds of scenes, and whether a scene is repeated with other perception noise."""
FAMILIES = ("edge_ii", "fragile_ii", "aisles")
TASK_OF_FAMILY = {"edge_ii": "edge_rescue", "fragile_ii": "fragile_transfer", "aisles": "mobile_navigation"}
ARM_PARAMETERS = {"clearance": (0.10, 0.30), "finger_axis": ("along", "across")}
ARM_VARIANTS = {
    "edge_ii": (("route", "opening"), (("direct", 0.055), ("near_base", 0.08))),
    "fragile_ii": (("route", "force"), (("direct", 10.0), ("near_base", 20.0))),
}
"""8 contracts per family of the arm: all values of clearance and finger axis, and two of route and family parameter."""
BASE_PARAMETERS = {"via": ("direct", "aisle_left", "aisle_right"), "stops": (0, 5)}
"""6 contracts of the base: the route, and the number of short stops before it starts."""
SPEED, TURN_RATE = 0.4, 1.0
"""[m/s], [rad/s]. A fast contract takes half the time, and depends more on the other parameters than one at 0.2 m/s."""


class FamilySweep:
    """Contract parameters matter in the other families, too."""

    name = "family_sweep"
    claim = (
        "In edge rescue, fragile transfer and navigation of level II, at fixed speed: the worst and the best Δ of "
        "successes differ threefold, rankings repeat under other noise (Spearman ≥ 0.5), success varies, and the best "
        "fixed contract has regret."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Seed by seed, every family in turn; any prefix of complete seeds is an unbiased sample."""
        del options
        return [
            _unit(family, seed, contract, again=again)
            for seed, again in SEEDS
            for family in FAMILIES
            for contract in contract_grid(family)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Execute the contract; all contracts of a scene have the same perception noise and 2 s of planning time."""
        family, seed = parameters["family"], parameters["seed"]
        spec = make_room(family, seed, "base") if family == "aisles" else make_scene(family, seed)
        noise = seed + NOISE_SEED_OFFSET * parameters["again"]
        goal = TASKS[TASK_OF_FAMILY[family]].goals["II"]
        return {
            **parameters,
            **run_row(
                run_contract(
                    spec, contract_actions(family, parameters["parameters"]), seed=noise, settle_s=2.0, goal=goal
                )
            ),
        }

    def summarize_row(self, row: Row) -> str:
        """The outcome and Δ."""
        return describe_outcome(row)

    def report(self, rows: list[Row]) -> list[str]:
        """Success by family, the four criteria, every violation."""
        return sensitivity_tables(rows, FAMILIES)


def contract_grid(family: str) -> list[dict[str, Any]]:
    """The contracts of a family, without their speed."""
    if family not in ARM_VARIANTS:
        return [dict(zip(BASE_PARAMETERS, values, strict=True)) for values in product(*BASE_PARAMETERS.values())]
    names, variants = ARM_VARIANTS[family]
    return [
        {**dict(zip(ARM_PARAMETERS, values, strict=True)), **dict(zip(names, variant, strict=True))}
        for values in product(*ARM_PARAMETERS.values())
        for variant in variants
    ]


def contract_actions(family: str, values: dict[str, Any]) -> list[dict[str, Any]]:
    """The actions of a contract of the grid."""
    if family in ARM_VARIANTS:
        goal = TASKS[TASK_OF_FAMILY[family]].goals["II"]
        grasp, place = pick_and_place_actions(**values)
        grasp["params"]["object"], place["params"]["destination"] = goal.object_name, goal.destination
        return [grasp, place]
    vias = [] if values["via"] == "direct" else [values["via"]]
    common = {"max_speed": values["speed"], "max_turn_rate": TURN_RATE}
    drives = [{"skill": "drive_to", "params": {"place": place, **common}} for place in (*vias, "shelf")]
    return [{"skill": "stop", "params": {}}] * values["stops"] + drives


def _unit(family: str, seed: int, values: dict[str, Any], *, again: bool) -> WorkUnit:
    parameters = {"speed": SPEED, **values}
    key = " ".join(str(value) for value in parameters.values())
    unit_parameters = {"family": family, "seed": seed, "parameters": parameters, "again": again}
    return WorkUnit(f"{family}:{seed} {key}" + (" again" if again else ""), unit_parameters)
