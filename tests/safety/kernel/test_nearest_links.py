"""The nearest links that a step keeps for the next one never change a result, and culling never changes a bit."""

import shutil

import pytest

from tests.kernel.compilers import GCC, INCLUDES, ROOT, Program, kernel_sources
from tools.instruction_counts.robot_table import robot_table


def build(folder, robot, *flags, include=INCLUDES[0]):
    (folder / "robot_table.h").write_text(robot_table(robot))
    includes = [include, INCLUDES[1], f"-I{ROOT / 'tools/instruction_counts'}", f"-I{folder}"]
    program = folder / "nearest_links"
    source = ROOT / "tests/safety/kernel/nearest_links.c"
    GCC.run("-O2", *flags, *includes, *kernel_sources(), str(source), "-o", str(program))
    return Program(program)


@pytest.mark.parametrize(
    ("robot", "flags", "steps"),
    [
        ("panda", ("-DDBK_LANES=1",), 4000),
        pytest.param("ur5e", (), 200_000, marks=pytest.mark.slow),
        pytest.param("panda", (), 200_000, marks=pytest.mark.slow),
    ],
    ids=["panda without vectors", "ur5e, long", "panda, long"],
)
def test_arbitrary_kept_links_give_the_same_bits(tmp_path, robot, flags, steps):
    """Also after a new scene, a grasp, a jump of the joints and another opening, without any reset."""
    ran, culled_differently, _ = build(tmp_path, robot, *flags).output_lines(str(steps))[-1].split()
    assert int(ran) == steps
    assert int(culled_differently) > steps // 100, "the kept links have an effect on the culling"


@pytest.mark.parametrize(
    ("robot", "steps"),
    [
        ("panda", 5_000),
        ("ur5e", 5_000),
        pytest.param("ur5e", 10_000, marks=pytest.mark.slow),
        *(pytest.param(r, 200_000, marks=pytest.mark.slow) for r in ("panda", "fr3")),
    ],
    ids=["panda", "ur5e", "ur5e, long", "panda, long", "fr3, long"],
)
def test_the_cull_by_direction_does_not_change_a_bit(tmp_path, robot, steps):
    """All results and rows of a kernel without this cull: a huge rounding error of velocities disables it."""
    include = shutil.copytree(ROOT / "kernel/include", tmp_path / "include")
    config = include / "dbk/dbk_config.h"
    text = config.read_text()
    assert text.count("DBK_VELOCITY_ROUNDING ((dbk_real)4e-6)") == 1
    config.write_text(text.replace("DBK_VELOCITY_ROUNDING ((dbk_real)4e-6)", "DBK_VELOCITY_ROUNDING ((dbk_real)1e9)"))
    culled = build(tmp_path, robot).output_lines(str(steps))[-1].split()
    complete = build(tmp_path, robot, include=f"-I{include}").output_lines(str(steps))[-1].split()
    assert culled[2] == complete[2]
