"""Run a given contract in simulation: gate, skills, filter and plant, without planner, memory or model weights.

Run: `python examples/03_run_a_contract.py`. Needs MuJoCo (`pip install 'dualbrain[simulation]'`).
"""

from __future__ import annotations

from dualbrain import Accepted, SimulatedCell, make_scene

GRASP = {
    "object": "red_cube",
    "speed": 0.3,
    "clearance": 0.10,
    "finger_axis": "along",
    "opening": 0.07,
    "approach": "top",
    "wait": "none",
    "force": 20,
}
PLACE = {"destination": "blue_bowl", "speed": 0.3, "clearance": 0.10, "route": "direct", "wait": "none"}


def main() -> None:
    """Put the red cube into the bowl of the bare scene and print the events and the outcome."""
    with SimulatedCell.make("panda", make_scene("bare", 1), on_event=print_event) as cell:
        contract = cell.contract([{"skill": "grasp", "params": GRASP}, {"skill": "place", "params": PLACE}])
        verdict = cell.check(contract)
        if not isinstance(verdict, Accepted):
            print(f"rejected at {verdict.stage}: {verdict.hint}")
            return
        outcome = cell.execute(verdict.contract)
        truth = cell.judgement()
    print(f"\n{outcome.kind}: {outcome.reason}")
    print(
        f"Δ {outcome.Delta:.4f}, intervention on {outcome.intervention_frequency:.1%} of ticks, "
        f"minimum clearance {outcome.h_min * 1000:.1f} mm beyond all margins, {outcome.duration:.1f} s of motion"
    )
    print(f"simulator ground truth: {'success' if truth.success else 'no success'}, {len(truth.violations)} violations")


def print_event(event) -> None:
    """Print one event of the log."""
    print(f"{event.t:6.2f} s  {event.text}")


if __name__ == "__main__":
    main()
