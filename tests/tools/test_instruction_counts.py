"""The instructions of one step on a Cortex-M4F do not grow, and its results have the bits of the committed loops."""

import pytest

from tools.instruction_counts import measure
from tools.instruction_counts.measure import OBSTACLES, SHIPPED, Build

TOLERANCE = 0.01
PANDA = Build("zig", "-O2", "panda")


@pytest.fixture(scope="module")
def committed():
    return measure.committed_counts()


def check(committed, program, folder, obstacles):
    for loop in measure.measure(program, folder, obstacles):
        recorded = committed[program.name][str(loop.obstacles)]
        assert loop.hash == recorded["hash"], "the results changed"
        for name, got in (("mean", loop.mean), ("most", loop.most)):
            advice = "after an intended change, run `python -m tools.instruction_counts --record --write-docs`"
            assert got == pytest.approx(recorded[name], rel=TOLERANCE), f"{name} with {loop.obstacles}; {advice}"


def test_a_step_has_the_committed_number_of_instructions(tmp_path, committed):
    check(committed, PANDA, tmp_path, (0, 12))


@pytest.mark.slow
@pytest.mark.parametrize("program", [p for p in SHIPPED if p.toolchain == "zig"], ids=lambda program: program.name)
def test_every_build_has_the_committed_number_of_instructions(tmp_path, committed, program):
    check(committed, program, tmp_path, OBSTACLES)


def test_two_runs_count_the_same(tmp_path):
    loops = [measure.measure(PANDA, tmp_path, (4,), steps=20)[0] for _ in range(2)]
    assert loops[0] == loops[1]


def test_compilers_and_levels_give_the_same_bits(committed):
    for robot in ("panda", "ur5e", "ur5e_lean", "fr3"):
        for count in map(str, OBSTACLES):
            assert len({committed[p.name][count]["hash"] for p in SHIPPED if p.robot == robot}) == 1


def test_the_worst_step_with_twelve_obstacles_is_below_the_target(committed):
    """150 000 instructions: the target for the arm with the compiler of the firmware."""
    assert max(committed[f"gcc {level} panda"]["12"]["most"] for level in ("-O2", "-Os")) <= 155_000
    assert committed["gcc -O2 panda"]["12"]["most"] <= 150_000


def test_the_lean_cover_saves_a_quarter_of_the_instructions(committed):
    for program in SHIPPED:
        if program.robot == "ur5e":
            lean = committed[program.name.replace("ur5e", "ur5e_lean")]["12"]
            assert lean["mean"] <= 0.75 * committed[program.name]["12"]["mean"]
            assert lean["most"] <= 0.75 * committed[program.name]["12"]["most"]
