"""All proofs by name, in the order in which they are run."""

from __future__ import annotations

from experiments.adaptation.ablation_curve import AdaptCurve
from experiments.adaptation.retention import Retention
from experiments.adaptation.rounds import Rounds
from experiments.adaptation.starter import Starter
from experiments.adaptation.suite_adapters import Nights
from experiments.engine.experiment import Proof
from experiments.gatekeeper.commander_failure import Cortex
from experiments.gatekeeper.faults import Faults
from experiments.gatekeeper.fuzz_socket import FuzzSocket
from experiments.gatekeeper.tick import Tick
from experiments.memory.crash_recovery import Kills
from experiments.memory.learning import Learning
from experiments.memory.poisoning import Poisoning
from experiments.planning.end_to_end import Contrast, Runs
from experiments.planning.family_sweep import FamilySweep
from experiments.planning.language import Language
from experiments.planning.sensitivity_sweep import Sweep
from experiments.robots.cross_embodiment import Robots
from experiments.robots.grasping import Picks
from experiments.robots.robosuite_tasks import Outsider
from experiments.robots.robot_zoo import Zoo
from experiments.safety.adversary import Adversary
from experiments.safety.conservatism import Conservatism
from experiments.safety.no_obstacles import Bare
from experiments.safety.plant_adversary import PlantAdversary
from experiments.safety.slow_tests import Kernel

PROOFS: dict[str, Proof] = {
    proof.name: proof
    for proof in (
        Picks(), Bare(), Sweep(), FamilySweep(), Runs(), Contrast(), Conservatism(), Kernel(), Adversary(),
        PlantAdversary(), Robots(), Zoo(), Kills(), Poisoning(), Learning(),
        Faults(), Cortex(), FuzzSocket(), Tick(), Language(), AdaptCurve(), Retention(), Rounds(), Nights(),
        Starter(), Outsider(),
    )
}  # fmt: skip
"""`contrast` comes after `runs`, whose contracts it carries out."""
