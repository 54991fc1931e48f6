"""Write the hashes of the reported suite's scenes: python scripts/freeze_scenes.py (after a wanted change only)."""

from __future__ import annotations

from dualbrain.simulation.tasks.scene_hashes import FILE, frozen_table

SEEDS = range(40_000, 40_050)
"""The first seeds of the range for tests."""

if __name__ == "__main__":
    FILE.write_text(frozen_table(SEEDS), encoding="utf-8")
