"""Evaluation protocol (paper 7): methods, runner, metrics, statistics, hypotheses, report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.evaluation.analysis.metrics import METRICS
    from dualbrain.evaluation.analysis.statistics import Estimate, PairedComparison, compare, estimate
    from dualbrain.evaluation.protocol.method import METHODS, Method, find_method
    from dualbrain.evaluation.protocol.suite import Suite, Task, load_suite
    from dualbrain.evaluation.results.episode_row import EpisodeRow
    from dualbrain.evaluation.results.parquet import read_results, write_results
    from dualbrain.evaluation.runner.runner import Runner

_MODULES = {
    "evaluation.analysis.metrics": ("METRICS",),
    "evaluation.analysis.statistics": (
        "Estimate",
        "PairedComparison",
        "compare",
        "estimate",
    ),
    "evaluation.protocol.method": (
        "METHODS",
        "Method",
        "find_method",
    ),
    "evaluation.protocol.suite": (
        "Suite",
        "Task",
        "load_suite",
    ),
    "evaluation.results.episode_row": ("EpisodeRow",),
    "evaluation.results.parquet": (
        "read_results",
        "write_results",
    ),
    "evaluation.runner.runner": ("Runner",),
}
"""Public names by the module that defines them."""

__all__ = [
    "METHODS",
    "METRICS",
    "EpisodeRow",
    "Estimate",
    "Method",
    "PairedComparison",
    "Runner",
    "Suite",
    "Task",
    "compare",
    "estimate",
    "find_method",
    "load_suite",
    "read_results",
    "write_results",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
