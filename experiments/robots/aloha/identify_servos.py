"""Identify how the servos of gym-aloha's arms follow their commands, with an empty hand and with a load.

Run: python -m experiments.robots.aloha.identify_servos [--seeds 16] [--seconds 10] [--load 0.05] [--write FILE]

The method is that of `dualbrain robot identify --drive position`, on the MuJoCo model of gym-aloha, whose steps of
20 ms are the periods of the identification. A real arm has other servos: identify it, or keep a larger error.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import mujoco

from dualbrain import __version__
from dualbrain.robots.loader import encode_robot, load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.identification.tracking_model import TrackingModel, identify_tracking
from experiments.robots.aloha.servo_arm import STEP_TIME, ServoArm


def identify_servos(robot_model: RobotModel, *, seeds: int, seconds: float, load: float) -> TrackingModel:
    """The tracking model of the servos at the limits of `robot_model`, for loads of 0 and `load` [kg]."""

    def make(kg: float) -> Callable[[], ServoArm]:
        return lambda: ServoArm(load=kg, start=robot_model.home)

    def report_progress(share: float, text: str) -> None:
        print(f"{share:4.0%} {text}", file=sys.stderr)

    return identify_tracking(
        [make(0.0), make(load)],
        msgspec.structs.replace(robot_model, period=STEP_TIME),
        seeds=range(seeds),
        seconds=seconds,
        source=f"vx300s, position servos, loads 0, {load:g} kg",
        progress=report_progress,
    )


def main() -> int:
    """Command line: print the tracking model, and replace it in a robot model file with --write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--load", type=float, default=0.05)
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    robot_model = load_robot("vx300s")
    found = identify_servos(robot_model, seeds=options.seeds, seconds=options.seconds, load=options.load)
    arguments = f"--seeds {options.seeds} --seconds {options.seconds:g} --load {options.load:g}"
    provenance = (
        f"python -m experiments.robots.aloha.identify_servos {arguments}; MuJoCo model and servo gains of gym-aloha "
        f"0.1.5, MuJoCo {mujoco.__version__}; dualbrain {__version__}, {datetime.now(UTC):%Y-%m-%d}"
    )
    print(f"lag {found.lag * 1e3:.1f} ms, e {found.position_error * 1e3:.1f} mrad at {found.rate:g} 1/s")
    print("e by joint [mrad]: " + ", ".join(f"{1e3 * value:.1f}" for value in found.largest))
    print("e by seed [mrad]: " + ", ".join(f"{1e3 * value:.1f}" for value in found.by_seed))
    if options.write:
        tracking = found.to_error_model("position", provenance)
        options.write.write_bytes(encode_robot(msgspec.structs.replace(robot_model, tracking=tracking)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
