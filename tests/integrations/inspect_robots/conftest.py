"""The connector of inspect-robots on the path, and a stand-in that an installed inspect-robots replaces."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
sys.path += [str(ROOT / "integrations" / "inspect_robots"), str(HERE / "stand_in")]
