"""Tables of the results, and docs/reference/safety/kernel.md."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

METHOD = """The kernel is C99 without heap, recursion, globals, libm or function pointers; the following values are read
from the compiled objects. Its results are bit-identical between gcc (-O0, -O1, -O2, -O3, -Os, -march=native, with and
without vectors) and clang (-O0 to -O3, -Os, with and without fused multiply-add): `tests/kernel` compares hashes
of all results of cases that together execute every line."""
MEMORY_NOTE = """All values in bytes. The caller provides one `dbk_model`, `dbk_scene` and `dbk_ctx` per robot. The host
allows 512 obstacles, the microcontrollers 48."""


def report_tables(found: dict[str, Any]) -> list[str]:
    """Return all results as Markdown tables."""
    return [
        *_memory(found["compiled"]),
        "",
        *_stack(found["compiled"]),
        "",
        *_symbols(found["compiled"]),
        "",
        *_steps(found["steps"]),
    ]


def _memory(compiled: list[dict[str, Any]]) -> list[str]:
    names = list(compiled[0]["sizes"])
    lines = [f"| target | compiler | code | {' | '.join(names)} | largest stack |", "|" + "---|" * (len(names) + 4)]
    for one in compiled:
        stack = max(path["stack"] for path in one["paths"].values())
        parts = [one["target"], one["compiler"], one["code"], *one["sizes"].values(), stack]
        lines.append(
            "| " + " | ".join(f"{p:,}".replace(",", " ") if isinstance(p, int) else str(p) for p in parts) + " |"
        )
    return [
        *lines,
        "",
        MEMORY_NOTE,
    ]


def _stack(compiled: list[dict[str, Any]]) -> list[str]:
    lines = []
    for one in (one for one in compiled if "float32" in one["target"] or "M7, -O2" in one["target"]):
        lines += [f"Frames of {one['target']} [bytes]:", "", "| function | frame |", "|---|---|"]
        lines += [f"| `{name}` | {size} |" for name, size in one["frames"].items() if size >= 64]
        for entry, path in one["paths"].items():
            calls = " → ".join(f"`{name}`" for name in path["functions"])
            lines += ["", f"Deepest call path of `{entry}`: {calls}, {path['stack']} bytes."]
        lines.append("")
    return lines[:-1]


def _symbols(compiled: list[dict[str, Any]]) -> list[str]:
    lines = ["| target | recursion | function pointers | external symbols | not allowed |", "|---|---|---|---|---|"]
    for one in compiled:
        cells = [one["target"], one["recursion"], one["addresses_taken"], one["foreign"], one["not_allowed"]]
        lines.append("| " + " | ".join(_cell(cell) for cell in cells) + " |")
    return lines


def _cell(value: Any) -> str:
    return value if isinstance(value, str) else ", ".join(map(str, value)) or "none"


def _steps(s: dict[str, Any]) -> list[str]:
    lines = [
        f"{s['steps']} steps in {s['scenes']} scenes:",
        "",
        "| per step | median | p99 | p99.9 | max | limit |",
        "|---|---|---|---|---|---|",
    ]
    for title, key, limit in (
        ("QP iterations", "iterations", s["cap"]),
        ("rows", "rows", s["most_rows"]),
        ("time [µs]", "microseconds", ""),
    ):
        cells = [f"{s[key][name]:.4g}" for name in ("median", "p99", "p999", "max")]
        lines.append(f"| {title} | {' | '.join(cells)} | {limit} |")
    most = max(s["histogram"])
    bars = [
        f"{k:3} {count:8} {'#' * max(1, round(50 * count / most)) if count else ''}".rstrip()
        for k, count in enumerate(s["histogram"])
    ]
    hard, program = s["hardest"], s["program"]
    return [
        *lines,
        "",
        "Times are processor times of one warm-started step in C, including the clock reads, on a busy machine. "
        f"The slowest steps, repeated without a warm start, take at most {s['repeated_microseconds']:.1f} µs.",
        "",
        f"Worst step found by the search: {hard['iterations']} iterations with {hard['rows']} rows, "
        f"{hard['microseconds']:.1f} µs without a warm start. Worst random QP (8 controls): "
        f"{program['iterations']} iterations with {program['rows']} rows. A step at the limit of iterations brakes.",
        "",
        "Steps by QP iterations:",
        "",
        "```",
        *bars,
        "```",
    ]


def render_page(found: dict[str, Any]) -> str:
    """Return the text of docs/reference/safety/kernel.md."""
    return "\n".join(
        [
            "# The compiled kernel",
            "",
            f"Written by `python -m tools.kernel_limits --write-docs` on {datetime.now(UTC):%Y-%m-%d}, revision "
            f"{found['revision']}, kernel {found['kernel']}, {found['machine']}.",
            "",
            METHOD,
            "",
            *report_tables(found),
            "",
        ]
    )
