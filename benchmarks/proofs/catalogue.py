"""All proofs by name, in the order in which they are run."""

from __future__ import annotations

from proofs.bare import Bare
from proofs.conservatism import Conservatism
from proofs.kernel import Kernel
from proofs.picks import Picks
from proofs.proof import Proof
from proofs.runs import Contrast, Runs
from proofs.sweep import Sweep

PROOFS: dict[str, Proof] = {
    proof.name: proof for proof in (Picks(), Bare(), Sweep(), Runs(), Contrast(), Conservatism(), Kernel())
}
"""`contrast` comes after `runs`, whose contracts it carries out."""
