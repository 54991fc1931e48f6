"""The scenes of the reported suite, frozen: a hash of each is committed, so that a drift of a generator is noticed.

A generator and its seed are the scene; `scene_hashes.toml` says which one it was when it was reported. Numbers count
to a micrometre, because libraries of different machines differ in a sine's last digit. The robot is no part of the
hash: arms have the same things before them.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.families import LEVELS, TASK_FAMILIES, Level

HASH_FILE = Path(__file__).with_name("scene_hashes.toml")
N_DIGITS, HASH_LENGTH = 6, 12


def scene_hash(spec: SceneSpec) -> str:
    """First 12 hex digits of the SHA-256 of everything in `spec` but robot and map, lengths to a micrometre."""
    said = msgspec.to_builtins(spec)
    del said["robot"], said["chart"]
    return hashlib.sha256(json.dumps(_round_floats(said), sort_keys=True).encode()).hexdigest()[:HASH_LENGTH]


def expected_hash(family: str, level: Level, seed: int) -> str | None:
    """The committed hash of a scene; None for one that is not part of the reported suite."""
    table = _load_hashes()
    hashes, index = table[family][level], seed - table["first"]
    return hashes[index] if 0 <= index < len(hashes) else None


def check_scene_hash(family: str, level: Level, seed: int, spec: SceneSpec) -> None:
    """Raise `InvalidSetup` if `spec` is not the scene that was reported under this name."""
    wanted, got = expected_hash(family, level, seed), scene_hash(spec)
    if wanted not in (None, got):
        fix = "A generator has changed: results before and after cannot be compared. Freeze anew and say so."
        raise ConfigurationError(
            f"scene {family} {level} {seed}", got=got, allowed=f"the frozen one, {wanted}", fix=fix
        )


def format_hash_file(seeds: range) -> str:
    """The text of `scene_hashes.toml` for `seeds`, every family at every level."""
    lines = ["# The scenes of the reported suite (frozen.py); written by scripts/freeze_scenes.py.", ""]
    lines.append(f"first = {seeds.start}")
    for name, family in TASK_FAMILIES.items():
        lines += ["", f"[{name}]"]
        robot = "base" if family.mobile else "panda"
        for level in LEVELS:
            hashes = [f'"{scene_hash(family.make_scene(level, seed, robot))}"' for seed in seeds]
            lines += [f"{level} = [", *(f"  {', '.join(row)}," for row in _split_rows(hashes)), "]"]
    return "\n".join(lines) + "\n"


def _split_rows(hashes: list[str], width: int = 7) -> Iterable[list[str]]:
    return (hashes[start : start + width] for start in range(0, len(hashes), width))


def _round_floats(said: Any) -> Any:
    match said:
        case dict():
            return {name: _round_floats(value) for name, value in said.items()}
        case list() | tuple():
            return [_round_floats(value) for value in said]
        case float():
            return round(said, N_DIGITS) + 0.0
        case _:
            return said


@cache
def _load_hashes() -> dict[str, Any]:
    return tomllib.loads(HASH_FILE.read_text(encoding="utf-8"))
