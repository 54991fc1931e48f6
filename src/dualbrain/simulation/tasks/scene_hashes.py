"""Hashes of the scenes of the reported suite, which detect a change of a scene generator.

A generator and a seed determine a scene; `scene_hashes.toml` contains the hash of each scene at the time of the report.
Numbers are rounded to a micrometre, because mathematical libraries differ in the last digits. The robot is not part of
the hash: different arms have the same objects in front of them.
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
    """First 12 hex digits of the SHA-256 of `spec` without robot and map, with lengths rounded to a micrometre."""
    content = msgspec.to_builtins(spec)
    del content["robot"], content["chart"]
    return hashlib.sha256(json.dumps(_round_floats(content), sort_keys=True).encode()).hexdigest()[:HASH_LENGTH]


def expected_hash(family: str, level: Level, seed: int) -> str | None:
    """The committed hash of a scene; None for a scene that is not part of the reported suite."""
    table = _load_hashes()
    hashes, index = table[family][level], seed - table["first"]
    return hashes[index] if 0 <= index < len(hashes) else None


def check_scene_hash(family: str, level: Level, seed: int, spec: SceneSpec) -> None:
    """Raise `ConfigurationError` if `spec` is not the scene that was reported under this name."""
    expected, got = expected_hash(family, level, seed), scene_hash(spec)
    if expected not in (None, got):
        fix = (
            "A scene generator has changed, so new results are not comparable with reported ones. Undo the change, or "
            "write new hashes with scripts/freeze_scenes.py and state it in the report."
        )
        raise ConfigurationError(f"hash of scene {family} {level} {seed}", got=got, allowed=expected or "", fix=fix)


def format_hash_file(seeds: range) -> str:
    """The text of `scene_hashes.toml` for `seeds` of every family at every level."""
    lines = ["# Hashes of the scenes of the reported suite (scene_hashes.py); written by scripts/freeze_scenes.py.", ""]
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


def _round_floats(content: Any) -> Any:
    match content:
        case dict():
            return {name: _round_floats(value) for name, value in content.items()}
        case list() | tuple():
            return [_round_floats(value) for value in content]
        case float():
            return round(content, N_DIGITS) + 0.0
        case _:
            return content


@cache
def _load_hashes() -> dict[str, Any]:
    return tomllib.loads(HASH_FILE.read_text(encoding="utf-8"))
