"""Stack, calls and external symbols of objects, on programs with known properties."""

import platform
import subprocess

import pytest

from tools.kernel_limits.compiled import BARE_METAL_FLAGS, ZIG, run_compiler, summary
from tools.kernel_limits.elf import read_object
from tools.kernel_limits.stack_usage import cycles, deepest_call_path

RED_ZONE = ["-mno-red-zone"] if platform.machine() == "x86_64" else []
PROGRAM = """
#include <stdlib.h>
double sqrt(double);
__attribute__((noinline)) static int leaf(volatile char *p) {
  volatile char big[1000];
  big[*p & 511] = *p;
  return big[*p & 255];
}
__attribute__((noinline)) int deep(int n) {
  volatile char big[500];
  big[n & 255] = (char)n;
  return leaf(big) + (n ? deep(n - 1) : 0);
}
int dbk_step(int n) { volatile char some[100]; some[0] = 1; return deep(n) + leaf(some); }
int dbk_project(double x) { void *p = malloc(8); free(p); return (int)sqrt(x); }
int (*pointer)(int) = deep;
"""


@pytest.fixture
def objects(tmp_path):
    """The object of the program compiled with gcc, and its frames."""
    source = tmp_path / "p.c"
    source.write_text(PROGRAM)
    flags = [
        "-O1",
        "-fno-optimize-sibling-calls",
        "-ffunction-sections",
        "-fno-builtin",
        "-c",
        str(source),
        "-o",
        "p.o",
    ]
    subprocess.run(["gcc", "-fstack-usage", *RED_ZONE, *flags], cwd=tmp_path, check=True)
    frames = {
        line.split("\t")[0].rsplit(":", 1)[-1]: int(line.split("\t")[1])
        for line in (tmp_path / "p.su").read_text().splitlines()
    }
    return read_object(tmp_path / "p.o"), frames


def test_recursion_pointers_and_libraries_are_found(objects):
    one, frames = objects
    found = summary([one], frames)
    assert found["recursion"] == [("deep", "deep")]
    assert found["addresses_taken"] == ["deep"]
    assert set(found["not_allowed"]) == {"malloc", "free", "sqrt"}
    assert found["unsized"] == []
    assert found["paths"]["dbk_step"]["stack"] == -1


def test_the_stack_of_the_deepest_path_is_the_sum_of_its_frames(objects):
    one, frames = objects
    calls = {name: callees - {name} for name, callees in one.calls.items()}
    path = deepest_call_path("dbk_step", calls, frames)
    assert path.functions == ("dbk_step", "deep", "leaf")
    assert path.stack == frames["dbk_step"] + frames["deep"] + frames["leaf"] > 1600


def test_cycles_are_found_only_in_cyclic_calls():
    assert cycles({"a": {"b", "c"}, "b": {"c"}}) == []
    assert cycles({"a": {"b"}, "b": {"a"}}) == [("a", "b", "a")]


def test_objects_for_a_microcontroller_are_read(tmp_path):
    source = tmp_path / "p.c"
    source.write_text(PROGRAM.replace("#include <stdlib.h>", "void *malloc(unsigned); void free(void *);"))
    run_compiler(
        (
            *ZIG,
            *BARE_METAL_FLAGS,
            "-mcpu=cortex_m7+fp_armv8d16sp",
            "-O1",
            "-ffunction-sections",
            "-c",
            str(source),
            "-o",
            str(tmp_path / "p.o"),
        )
    )
    one = read_object(tmp_path / "p.o")
    assert one.calls["dbk_step"] >= {"deep", "leaf"}
    assert one.stack["leaf"] >= 1000
    assert {"malloc", "free", "sqrt"} <= one.undefined
