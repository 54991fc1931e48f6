"""One part of an evaluation: all methods on some of the clusters, so that every part can run on its own machine.

A cluster is a run of one task on one robot. Methods share the answers and episodes of a cluster, so no part computes
what another part computes, except its pilot episodes and start ledgers if they were not prepared.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import msgspec

from dualbrain.errors import UsageError
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.runner.work_units import Stage, WorkUnit, all_clusters, build_units

PART_PATTERN = re.compile(r"([0-9]{1,4})/([0-9]{1,4})", re.ASCII)
FOLDER_PATTERN = re.compile(r"part-([0-9]{1,4})-of-([0-9]{1,4})", re.ASCII)
"""Name of the folder of a part, inside the folder of the evaluation."""


class Part(msgspec.Struct, frozen=True, order=True):
    """Part `number` (1 to `count`) of an evaluation in `count` parts."""

    count: int
    number: int

    @classmethod
    def parse(cls, text: str, suite: Suite) -> Part:
        """The part written `K/N`.

        Raises `UsageError` unless 1 ≤ K ≤ N and N is at most the number of clusters of `suite`, so that no part is
        empty.
        """
        clusters = len(all_clusters(suite))
        found = PART_PATTERN.fullmatch(text.strip())
        part = cls(int(found[2]), int(found[1])) if found else cls(0, 0)
        if not 1 <= part.number <= part.count <= clusters:
            allowed = f"K/N with 1 ≤ K ≤ N ≤ {clusters}, the number of runs of suite {suite.name} (task, robot, run)"
            raise UsageError("--part", got=text, allowed=allowed)
        return part

    @classmethod
    def of_folder(cls, folder: Path) -> Part | None:
        """The part whose results `folder` contains by its name; None for any other folder."""
        found = FOLDER_PATTERN.fullmatch(folder.name)
        return cls(int(found[2]), int(found[1])) if found else None

    def __str__(self) -> str:
        """`K/N`."""
        return f"{self.number}/{self.count}"

    def folder(self, out: Path) -> Path:
        """Folder of this part's results inside `out`, the folder of the evaluation."""
        return out / f"part-{self.number:02d}-of-{self.count:02d}"

    def clusters(self, suite: Suite) -> frozenset[str]:
        """The clusters of this part: every `count`-th in the order of the SHA-256 of their names.

        Neither the methods nor the order of the tasks influence the choice.
        """
        ordered = sorted(all_clusters(suite), key=lambda name: hashlib.sha256(name.encode()).digest())
        return frozenset(ordered[self.number - 1 :: self.count])

    def units(self, suite: Suite, stage: Stage) -> list[WorkUnit]:
        """The units of this part: those of its clusters, and the preparatory ones on which they depend."""
        chosen = self.clusters(suite)
        if stage in ("plan", "fly"):
            return [unit for unit in build_units(suite, stage) if unit.cluster in chosen]
        own = self.units(suite, "fly")
        if stage == "pilot":
            robots = {unit.robot for unit in own}
            return [unit for unit in build_units(suite, stage) if unit.robot in robots]
        places = {(unit.robot, unit.task.base_name) for unit in own if find_method(unit.method).uses_memory}
        return [unit for unit in build_units(suite, stage) if (unit.robot, unit.task.name) in places]
