"""All proofs by name, in the order in which they are run."""

from __future__ import annotations

from proofs.adapt_curve import AdaptCurve
from proofs.adversary import Adversary
from proofs.bare import Bare
from proofs.conservatism import Conservatism
from proofs.cortex import Cortex
from proofs.family_sweep import FamilySweep
from proofs.faults import Faults
from proofs.fuzz_socket import FuzzSocket
from proofs.kernel import Kernel
from proofs.kills import Kills
from proofs.language import Language
from proofs.learning import Learning
from proofs.nights import Nights
from proofs.outsider import Outsider
from proofs.picks import Picks
from proofs.plant_adversary import PlantAdversary
from proofs.poisoning import Poisoning
from proofs.proof import Proof
from proofs.retention import Retention
from proofs.robots import Robots
from proofs.rounds import Rounds
from proofs.runs import Contrast, Runs
from proofs.starter import Starter
from proofs.sweep import Sweep
from proofs.tick import Tick
from proofs.zoo import Zoo

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
