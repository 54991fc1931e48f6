"""Write the hashes of the scenes of the reported suite; use it only after an intended change of a scene generator.

python scripts/freeze_scenes.py
"""

from __future__ import annotations

from dualbrain.simulation.tasks.scene_hashes import HASH_FILE, format_hash_file

SEEDS = range(40_000, 40_050)
"""The first 50 seeds of the range for tests."""

if __name__ == "__main__":
    HASH_FILE.write_text(format_hash_file(SEEDS), encoding="utf-8")
