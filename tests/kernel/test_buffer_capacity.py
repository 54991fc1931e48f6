"""Full buffers: no loop over joints, links, spheres, pairs or obstacles reads beyond the last one."""

from tests.kernel.compilers import GCC, build_program

FILLED = [f"-DDBK_MAX_{what}={count}" for what, count in (("DOF", 7), ("SPHERES", 12), ("LINKS", 8), ("PAIRS", 5))]
"""The arm of the C tests has seven joints, twelve spheres on eight links and five pairs."""
CHECKED = ["-O1", "-Wno-error", "-fsanitize=bounds", "-fno-sanitize-recover=all"]


def test_no_loop_reads_beyond_the_last_joint(tmp_path):
    """With larger buffers, the memory behind the last joint is valid and hides the error; here it ends the program."""
    cases = build_program(tmp_path, "golden", GCC, *CHECKED, *FILLED).output_lines()
    assert len(cases) > 20
    counts = [
        int(word)
        for word in build_program(tmp_path, "arbitrary_input", GCC, *CHECKED, *FILLED).output_lines("2000")[-1].split()
    ]
    assert all(count > 0 for count in counts[1:])


def test_no_loop_reads_beyond_the_last_obstacle(tmp_path):
    """Sixteen obstacles near one link fill the table."""
    rows = build_program(
        tmp_path, "full_obstacle_table", GCC, *CHECKED, "-fsanitize=address", *FILLED, "-DDBK_MAX_OBSTACLES=16"
    ).output_lines()
    assert int(rows[-1]) > 1000
