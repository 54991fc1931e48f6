"""Write the hashes of the reported suite's scenes: python scripts/freeze_scenes.py (after a wanted change only)."""

from __future__ import annotations

from dualbrain.simulation.tasks.scene_hashes import HASH_FILE, format_hash_file

SEEDS = range(40_000, 40_050)
"""The first seeds of the range for tests."""

if __name__ == "__main__":
    HASH_FILE.write_text(format_hash_file(SEEDS), encoding="utf-8")
