"""The loops of the kernel and their bounds, read from the sources."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

from tools.kernel_limits.compiled import ROOT

LOOP = re.compile(r"\b(for|while) \((.*?)\) (?:\{|[a-z*+-])")
COUNTED = re.compile(r"(?:int32_t )?\w* ?=? ?[^;]*; (\w+) (<|<=|>=) ([^;&]+); (?:\+\+\1|--\1|\1 \+= \w+)$")
"""A loop over a counter that one comparison limits and only the loop header changes."""
OTHER_BOUNDS = {
    "int32_t i = 0; valid && i < 3; ++i": "3",
    "int32_t r = 0; valid && r < scene->n_user; ++r": "scene->n_user",
    "o < scene->n_obstacles && obstacle_valid(&scene->obstacle[o])": "scene->n_obstacles",
    "int32_t o = 0; o < scene->n_obstacles && o <= invalid; ++o": "scene->n_obstacles",
    "int32_t l = 0; l <= model->n_links; l = end": "model->n_links, as end > l",
    "end <= model->n_links && dbk_link_frame(model, end) == frame": "model->n_links",
    "int32_t tries = 0; ctx->trust_active && found == 0 && tries < DBK_TRUST_TRIES; ++tries": "DBK_TRUST_TRIES",
    "uint32_t bits = relevant[o]; bits; bits &= bits - 1u": "32: every turn clears one bit",
    "int32_t l = 0; any && l < DBK_LANES && base + l < c->count; ++l": "DBK_LANES",
    "; k + 1 < n; k += 2": "n",
    "int32_t r = rows->count; r < DBK_MAX_ROWS && r % DBK_LANES != 0; ++r": "DBK_LANES",
    "int32_t r = 0; r < count && rows->count < DBK_MAX_ROWS; ++r": "count",
    "int32_t r = 0; r < rows->count && kept < DBK_MAX_ROWS; ++r": "rows->count",
    "int32_t r = first; r < end && rows->count < DBK_MAX_ROWS; ++r": "end",
    "int32_t w = 0; w < ctx->n_warm && count < DBK_QP_DIM; ++w": "ctx->n_warm",
    "int32_t c = 0; c < speed->n_cuts && kept < DBK_MAX_CUTS; ++c": "speed->n_cuts",
    "int32_t tries = 0; cut > 0 && tries < DBK_SPEED_ROUNDS; ++tries": "DBK_SPEED_ROUNDS",
    "int32_t i = 0; i < n_warm && i < p->n; ++i": "p->n",
    "; out->iterations < DBK_QP_MAX_ITERATIONS; ++out->iterations": "DBK_QP_MAX_ITERATIONS",
    "solution->iterations < DBK_QP_MAX_ITERATIONS": "DBK_QP_MAX_ITERATIONS: every added constraint counts",
    "int32_t i = removed < 0 ? 0 : removed + 1; i < members; ++i": "members",
}
"""Bounds of the other loops by their header."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop statement; `bound` is None if neither its form nor the table above gives one."""

    file: str
    line: int
    header: str
    bound: str | None


def kernel_loops() -> list[Loop]:
    """All loops of kernel/src."""
    found: list[Loop] = []
    for path in sorted((ROOT / "kernel/src").rglob("*.[ch]")):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            match = LOOP.search(line)
            if match:
                header = match.group(2)
                found.append(Loop(path.name, number, header, loop_bound(header)))
    return found


def loop_bound(header: str) -> str | None:
    """The bound of a loop, or None."""
    counted = COUNTED.match(header)
    return counted.group(3) if counted else OTHER_BOUNDS.get(header)


def bound_counts() -> dict[str, int]:
    """Number of loops by bound."""
    return dict(Counter(str(loop.bound) for loop in kernel_loops()).most_common())
