"""The kernel as a C program: the same bits at every optimisation level, nothing for the sanitizers to report."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FLAGS = [
    "-std=c99", "-ffp-contract=off", "-fno-math-errno", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow",
    "-Wdouble-promotion", "-Wstrict-prototypes", "-Wno-maybe-uninitialized", "-Werror",
]  # fmt: skip
SANITIZE = ["-O1", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]

GOLDEN = {"float32": "0fc1d21d53f28886", "float64": "1c8801ab65054c2b"}
"""Hash over every bit of ten thousand answers; changes only when the kernel's arithmetic is changed on purpose."""


def build(folder, program, *flags):
    out = folder / program
    sources = sorted(str(path) for path in (ROOT / "kernel/src").glob("*.c"))
    include = [f"-I{ROOT / 'kernel/include'}", f"-I{ROOT / 'tests/kernel'}"]
    source = str(ROOT / "tests/kernel" / f"{program}.c")
    subprocess.run(["gcc", *FLAGS, *flags, *include, *sources, source, "-o", str(out)], check=True)
    return out


def answer(program, *arguments):
    run = subprocess.run([str(program), *arguments], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout.split()


BUILDS = [["-O0"], ["-O3", "-fno-trapping-math"]]
MORE = [["-O3", "-march=native"], ["-Os"], ["-O2", "-fno-tree-vectorize"]]


@pytest.mark.parametrize("flags", [*BUILDS, *(pytest.param(f, marks=pytest.mark.slow) for f in MORE)], ids=" ".join)
def test_every_build_gives_the_same_bits(tmp_path, flags):
    assert answer(build(tmp_path, "golden", *flags))[0] == GOLDEN["float32"]


def test_the_float64_build_gives_its_own_bits(tmp_path):
    assert answer(build(tmp_path, "golden", "-O2", "-DDBK_DOUBLE"))[0] == GOLDEN["float64"]


@pytest.mark.parametrize(
    "real", [[], pytest.param(["-DDBK_DOUBLE"], marks=pytest.mark.slow)], ids=["float32", "float64"]
)
def test_arbitrary_bits_never_make_an_inadmissible_control(tmp_path, real):
    counts = [int(word) for word in answer(build(tmp_path, "hostile", *SANITIZE, *real), "6000")]
    assert all(count > 0 for count in counts[1:])  # modified, relaxed, stopped and faulty answers were all seen


@pytest.mark.slow
def test_a_million_arbitrary_inputs(tmp_path):
    answer(build(tmp_path, "hostile", "-O2"), "1000000")


def test_no_heap_no_libm_no_globals(tmp_path):
    """The objects refer to nothing but each other, memory moves, and hold no writable data."""
    allowed = {"memcpy", "memset", "memmove", "__stack_chk_fail"}
    for source in (ROOT / "kernel/src").glob("*.c"):
        target = tmp_path / f"{source.stem}.o"
        flags = ["gcc", *FLAGS, "-O1", f"-I{ROOT / 'kernel/include'}", "-c", str(source), "-o", str(target)]
        subprocess.run(flags, check=True)
        symbols = subprocess.run(["nm", str(target)], capture_output=True, text=True, check=True).stdout
        for line in symbols.splitlines():
            kind, name = line.split()[-2:]
            assert kind not in "bBdDC", f"{name} is writable data"
            assert kind != "T" or name.startswith("dbk_"), f"{name} lacks the prefix"
            assert kind != "U" or name.startswith("dbk_") or name in allowed, f"{name} comes from a library"
