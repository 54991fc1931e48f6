"""docs/reference/verification/static_analysis.md, from the results of the analyses."""

from __future__ import annotations

from typing import Any

from tools.static_analysis.loops import bound_counts, kernel_loops

PAGE = "docs/reference/verification/static_analysis.md"

INTRODUCTION = """Written by `python -m tools.static_analysis --write-docs`. `make analysis` repeats the analyses that
have no result of the current kernel; it needs the Debian packages frama-c-base, cppcheck, clang and libclang-rt-14-dev.
The harnesses are in `tests/static_analysis/harnesses`."""

OUTPUT = """## Output of a step

Every path of `dbk_step` ends in the function `finish`. Frama-C Eva (precision 2) analyses `finish` and
`dbk_intervention` with arbitrary bits in the control that the step computed, in the nominal control and in the
previous control, for eight joints. The assertion is that every component of the control is finite and within the
velocity limits. A NaN becomes standstill. The acceleration limits are not part of this assertion."""

STEP = """## Complete step

Eva (precision 1) analyses a loop of complete steps of the exported Panda with arbitrary bits in all fields of `dbk_in`
and of the scene, which changes before every step: up to 128 obstacles of all shapes, permits, held spheres and
additional rows, with room for 64 rows. An alarm is a place where Eva could not exclude a run-time error: an access
outside of an object, an index outside of an array, an overflow, an invalid shift or conversion. One assertion on the
control after each step is the same as above; the other one is that a scene with a number of obstacles, held spheres or
rows outside of its bounds is refused. Counts and indices that come from memory are bounded where they are used
(`dbk_bounded`).

Two limits of this analysis:

- Local variables count as initialised (`-eva-initialized-locals`): Eva does not relate the count of the loop that fills
  an array to the count of the loop that reads it. Their initialisation is tested instead, see below.
- Where a pointer passes a part of an array, Eva checks the bounds of the whole structure, not of the array in it. The
  fuzzer and `tests/kernel` (arbitrary bits, 10^6 inputs) run under sanitizers, which check the arrays."""

SUPERVISOR = """## Supervisor

Eva (precision 2) analyses an endless loop of updates of the state machine of the supervisor and of the enforcement of
its decisions, with arbitrary times, conditions and joint states. The assertions are that the action is one of the
table, and that the drive and the standstill are on or off. That the decisions are those of the host is tested with all
combinations of conditions that matter and over random sequences (`tests/safety/supervisor`, `tests/firmware`)."""

INITIALISATION = """## Initialisation of local variables

Builds in `tests/kernel` fill every local variable without a value with a pattern of bits, with and without SIMD, and
give the recorded bits of all golden cases. The fuzzer above also runs under the memory sanitizer, which reports a
branch or an address that depends on a value that was never set."""

MISRA = """## cppcheck and MISRA C:2012

cppcheck with its MISRA addon; only the numbers of the rules are given. This is no statement of compliance. Notes by
rule, and the reason for each deviation that is kept:"""

REASONS = {
    "12.1": "precedence of operators: arithmetic follows the usual precedence, without additional parentheses",
    "12.3": "the addon counts the commas in declarations of several variables",
    "10.3": "int results of comparisons are stored in int32_t",
    "10.1": "comparisons are combined by & and |, without a branch, so that loops vectorise",
    "10.4": "as 10.1",
    "15.5": "early returns for conditions that end a function",
    "15.4": "several breaks in one loop",
    "8.14": "restrict lets compilers vectorise",
    "14.4": "int32_t serves as truth value",
    "13.3": "increments within expressions, such as an index that advances after a write",
    "13.4": "chained assignments of the same constant",
    "18.4": "pointer plus offset: a block of an array is passed",
    "2.4": "tags of structures that only the typedef uses",
    "2.2": "an assignment that a later one replaces",
    "5.7": "names of enumerations in two functions",
    "5.9": "static functions of two files have the same name",
    "9.2": "nested initialisers without inner braces",
    "9.3": "partial initialisation: the rest is zero",
    "17.7": "the value of a function is not used",
    "17.8": "a parameter is changed in its function",
    "11.8": "a pointer to constant data is cast for a function without const parameters",
    "8.4": "a function for tests without a declaration in a public header",
    "8.7": "a function with external linkage that one file uses; tests use it too",
}


def render_page(results: dict[str, Any]) -> str:
    """Return the text of the page."""
    lines = ["# Static analysis and fuzzing", "", *INTRODUCTION.splitlines(), ""]
    lines += [*OUTPUT.splitlines(), "", _eva(results["output"]), ""]
    lines += [*STEP.splitlines(), "", _eva(results["step"]), ""]
    if kinds := results["step"]["kinds"]:
        lines += ["| alarm | number |", "|---|---|", *(f"| {name} | {count} |" for name, count in kinds.items()), ""]
    lines += [*SUPERVISOR.splitlines(), "", _eva(results["supervisor"]), ""]
    lines += ["## Fuzzing", "", *_fuzz(results["fuzz"]).splitlines(), ""]
    lines += [*INITIALISATION.splitlines(), "", _sequences(results["initialisation"]), ""]
    lines += [*_loops(), "", *MISRA.splitlines(), "", "| rule | notes | reason |", "|---|---|---|"]
    lines += [f"| {rule} | {count} | {REASONS.get(rule, '')} |" for rule, count in results["misra"]["rules"].items()]
    others = results["misra"]["others"]
    lines += ["", "Other findings of cppcheck: " + (", ".join(f"`{note}`" for note in others) or "none") + "."]
    if any(note.startswith("uninitvar") for note in others):
        lines += ["The uninitialised variable is a false alarm: its members are set before they are read."]
    return "\n".join([*lines, ""])


def _eva(result: dict[str, Any]) -> str:
    proven = result["assertions"]
    states = f"{proven['valid']} proven, {proven['unknown']} not proven, {proven['invalid']} refuted"
    return f"Kernel {result['kernel']}: **{result['alarms']} alarms**; assertions: {states}."


def _fuzz(result: dict[str, Any]) -> str:
    return (
        "libFuzzer with the address and undefined-behaviour sanitizers ran "
        f"{result['sequences']} sequences of steps, scenes and grasps in\n{result['seconds']} s (kernel "
        f"{result['kernel']}): {result['findings']} findings. It checks that the control is finite and within the\n"
        "velocity limits, that a rejected input stops the robot, and that the intervention is between 0 and 2."
    )


def _sequences(result: dict[str, Any]) -> str:
    return (
        f"Memory sanitizer: {result['sequences']} sequences in {result['seconds']} s (kernel {result['kernel']}): "
        f"{result['findings']} findings."
    )


def _loops() -> list[str]:
    head = f"The kernel has {len(kernel_loops())} loops; every one has a bound. Recursion, stack and memory: "
    lines = ["## Loops", "", head, "[The compiled kernel](../safety/kernel.md).", "", "| bound | loops |", "|---|---|"]
    return [*lines, *(f"| `{bound}` | {count} |" for bound, count in bound_counts().items())]
