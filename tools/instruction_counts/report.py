"""docs/reference/verification/instructions.md, from the committed counts."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from dualbrain.evaluation.runner.provenance import git_revision
from dualbrain.safety.cbf.kernel import kernel_hash
from tools.instruction_counts.measure import OBSTACLES, STEPS
from tools.kernel_limits.compiled import ROOT

PAGE = "docs/reference/verification/instructions.md"

BEFORE = {
    "gcc -O2 panda": {"0": (89.4, 134.4), "4": (104.9, 170.0), "12": (135.5, 262.7), "40": (183.1, 279.3)},
    "gcc -O2 ur5e": {"0": (146.0, 202.2), "4": (182.2, 347.4), "12": (212.1, 327.8), "40": (238.5, 431.4)},
    "gcc -O2 fr3": {"0": (68.3, 113.0), "4": (78.9, 135.4), "12": (113.1, 230.4), "40": (150.3, 260.0)},
    "gcc -Os panda": {"0": (91.5, 138.0), "4": (108.2, 181.4), "12": (139.8, 265.8), "40": (190.1, 293.5)},
    "gcc -Os ur5e": {"0": (146.6, 204.4), "4": (185.4, 366.9), "12": (216.2, 338.3), "40": (247.0, 441.5)},
    "gcc -Os fr3": {"0": (70.7, 112.9), "4": (82.3, 141.1), "12": (118.1, 239.5), "40": (156.6, 271.5)},
    "zig -O2 panda": {"0": (99.0, 152.7), "4": (118.4, 195.3), "12": (152.1, 297.8), "40": (208.8, 322.7)},
    "zig -O2 ur5e": {"0": (163.9, 228.8), "4": (207.7, 397.3), "12": (241.5, 377.3), "40": (273.1, 495.5)},
    "zig -O2 fr3": {"0": (75.0, 124.1), "4": (88.2, 155.8), "12": (127.0, 265.5), "40": (169.4, 302.7)},
    "zig -Os panda": {"0": (100.5, 152.8), "4": (119.0, 196.1), "12": (152.8, 297.4), "40": (207.1, 319.4)},
    "zig -Os ur5e": {"0": (164.5, 229.9), "4": (207.0, 394.8), "12": (240.3, 373.6), "40": (269.9, 491.4)},
    "zig -Os fr3": {"0": (76.2, 126.3), "4": (88.7, 154.8), "12": (127.0, 262.1), "40": (168.4, 297.9)},
}
"""Thousand instructions, mean and maximum, of the same loops with the kernel of revision f1b532ac."""

INTRODUCTION = f"""Instructions of one `dbk_step` on a Cortex-M4F with `DBK_LANES=1`, counted in the emulator Unicorn.
Each loop has {STEPS} steps with the default filter of the robot, obstacles of three kinds of which every fifth one
moves, and a nominal control that changes every 150 steps between the corners of the velocity limits. A loop gives the
same bits with both compilers, at both levels and on the host: the hashes in `tools/instruction_counts/counts.json` are
those of all results. Counts are exact and repeatable. They are no cycles: the emulator has no caches and no flash wait
states, and counts a division as one instruction. Nothing was measured on silicon."""

METHOD = """## Reduction

These changes kept the results bit for bit: the golden hashes in `tests/kernel/golden.json` did not change.

- **Direction of the motion.** A pair of links was tested sphere by sphere if its distance was small for the *magnitude*
  of the relative speed. Now the part of the velocity along the pair counts. For a rigid motion the product of the
  velocity and the difference of two centres is the same at both centres, so one velocity per proximal sphere suffices.
  The bound covers all controls within the trust region, and the rounding of the velocities
  (`DBK_VELOCITY_ROUNDING`). A link and an obstacle are tested the same way at the centre of the bounding sphere of
  the link (`distance/dbk_direction_cull.c`).
- **Nearest links of the last step.** The group of pairs with the smallest h is evaluated first. Its h is an upper bound
  of h_min, which culls more distant pairs earlier. Only indices are carried over, and every use checks that the group
  exists in the model and the scene; the distance is computed from the current state. No event has to reset it.
- **Factorisation of the active set.** If a constraint leaves, the constraints before it keep their directions, and
  only the later ones are factorised again.

Since then the rows keep the distance of a stop along the arc (2026-11-30). With 12 obstacles a step takes on average
6 % more instructions on the Panda with gcc -O2, 3 % on the FR3 and 14 % on the UR5e, because fewer pairs of links are
excluded by their bounds. The spatial motion of the frames is no longer copied, and a joint adds to the spheres that it
moves only.

`ur5e_lean` is the UR5e with 57 spheres in place of 108 (`LEAN_SPHERES` in `robots/builtin/ur5e.py`), with the same
kernel: fewer spheres of the arm and of the hand, fitted and verified to cover the same parts. With 12 obstacles a step
takes 29 % fewer instructions on average and 36 % fewer at most (gcc -O2). The rest of the largest step is the selection
of the active constraints: covers with 46 to 57 spheres have maxima of 152 to 193 thousand in the same loop, in no
order. The target of 150 thousand with 12 obstacles is met by the Panda and the FR3 with gcc -O2, and missed by 4 % by
`ur5e_lean`.
"""


def render_page(counts: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the text of the page."""
    lines = [
        "# Instructions of one step",
        "",
        f"Written by `python -m tools.instruction_counts --write-docs` on {datetime.now(UTC):%Y-%m-%d}, revision "
        f"{git_revision(ROOT / 'tools', ('src', 'kernel', 'tools'))}, kernel {kernel_hash()}.",
        "",
        *INTRODUCTION.splitlines(),
        "",
        "Thousand instructions, mean / maximum:",
        "",
        "| "
        + " | ".join(["compiler, robot", *(f"{n} obstacles" for n in OBSTACLES), "first step, 12 obstacles"])
        + " |",
        "|" + "---|" * (len(OBSTACLES) + 2),
    ]
    for name, loops in counts.items():
        if name in BEFORE:
            cells = [f"{mean:.0f} / {most:.0f}" for mean, most in (BEFORE[name][str(count)] for count in OBSTACLES)]
            lines.append(f"| {name}, revision f1b532ac | " + " | ".join(cells) + " | |")
        cells = [f"{loops[str(n)]['mean'] / 1e3:.0f} / {loops[str(n)]['most'] / 1e3:.0f}" for n in OBSTACLES]
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {loops['12']['first'] / 1e3:.0f} |")
    lines += ["", *METHOD.splitlines(), "", "## Regression check", "", *CHECK.splitlines(), ""]
    return "\n".join(lines)


CHECK = """`tests/tools/test_instruction_counts.py` repeats loops with the compiler of the package `ziglang`. It
fails if the mean or the maximum differs from the committed count by more than 1 %, or if a hash differs. After an
intended change, `python -m tools.instruction_counts --record --write-docs` writes new counts."""
