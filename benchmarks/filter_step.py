"""One step of the safety filter: time from Python and in C, warm and cold, by the number of obstacle rows.

Run: python -m benchmarks.filter_step [--json] [--figure FILE]

Rows are pairs of a robot sphere and an obstacle sphere. Setting `rows`: no acceleration limits, and obstacles so near
that most pairs are rows of the QP. Setting `shipped`: the default configuration, in which the acceleration limits
exclude rows that cannot bind in this step. Setting `speed`: as `shipped`, with the Cartesian speed limit of the robot
model. C times are processor time, Python times medians of wall time over blocks.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter
from dualbrain.safety.cbf.kernel import kernel_hash

N_SPHERES = 10
"""Robot spheres in the `rows` setting: two on each of the last five links with spheres."""


def thin_body():
    """Return the Panda with N_SPHERES moving spheres and no self-collision pairs: all rows are obstacle rows."""
    robot_model = load_robot("panda")
    chosen = []
    for link in ("link3", "link4", "link5", "link6", "hand"):
        chosen += [s for s in robot_model.spheres if s.link == link][:2]
    pairs = msgspec.structs.replace(robot_model.self_pairs, kept=())
    return msgspec.structs.replace(robot_model, spheres=tuple(chosen[:N_SPHERES]), self_pairs=pairs)


def make_filter(robot_model, n_obstacles, *, limits, speed=None):
    """Return a filter with `n_obstacles` random spheres around the arm (fixed seed)."""
    rng = np.random.default_rng(0)
    config = FilterConfig(lag_compensation=False, tracking_error=0.0, acceleration_limits=limits, cartesian_speed=speed)
    safety = SafetyFilter(robot_model, config)
    obstacles = []
    while len(obstacles) < n_obstacles:
        position = rng.uniform([0.1, -0.7, 0.0], [0.9, 0.7, 1.0])
        if np.linalg.norm(position - np.array([0.4, 0.0, 0.5])) > 0.3:
            obstacles.append(Obstacle(f"o{len(obstacles)}", Sphere(0.04), Pose(tuple(position.tolist()))))
    safety.observe(obstacles, 0.0)
    return safety


def record_episode(robot_model, n_obstacles, *, limits, speed=None, steps=1500):
    """Run a closed loop driven by sine waves.

    Returns joint positions (steps, n), nominal controls (steps, n), and the mean numbers of rows and QP iterations.
    """
    safety = make_filter(robot_model, n_obstacles, limits=limits, speed=speed)
    t = np.arange(steps)[:, None] * 1e-3
    rates = np.array([0.7, 1.1, 0.9, 1.3, 1.7, 1.9, 2.3])
    u_nom = np.ascontiguousarray(1.5 * np.sin(2 * np.pi * rates * t + np.arange(robot_model.n)))
    q, log, rows, iterations = np.array(robot_model.home), np.empty((steps, robot_model.n)), 0, 0
    for k in range(steps):
        log[k] = q
        result = safety.filter(
            RobotState(stamp=0.0, sequence=k, q=q, v=np.zeros(robot_model.n), opening=0.02, finger_forces=(0.0, 0.0)),
            u_nom[k],
            0.0,
        )
        rows, iterations = rows + result.n_rows, iterations + result.iterations
        q = q + 1e-3 * result.u
    return log, u_nom, rows / steps, iterations / steps


def python_time(safety, log, u_nom, block=50):
    """Return the median over blocks of the mean time of a `filter` call [s]."""
    states = [
        RobotState(stamp=0.0, sequence=k, q=q, v=np.zeros(len(q)), opening=0.02, finger_forces=(0.0, 0.0))
        for k, q in enumerate(log)
    ]
    times = []
    safety.reset()
    for start in range(0, len(states) - block, block):
        start_time = time.perf_counter()
        for k in range(start, start + block):
            safety.filter(states[k], u_nom[k], 0.0)
        times.append((time.perf_counter() - start_time) / block)
    return float(np.median(times))


def c_time(safety, log, u_nom, *, cold):
    """Return the smallest of five mean times of a step in C [s], which other load distorts least."""
    times = []
    for _ in range(5):
        safety.reset()
        times.append(safety._kernel.time_steps(log, u_nom, cold))
    return min(times)


def measure():
    """Return one record per setting and number of pairs; times in µs."""
    records = []
    settings = [("rows", thin_body(), n, n // N_SPHERES, False) for n in (10, 50, 100, 400)]
    panda = load_robot("panda")
    settings += [("shipped", panda, 100 * k, k, True) for k in (1, 4, 10, 40)]
    settings += [("speed", panda, 100 * k, k, True) for k in (1, 4, 10, 40)]
    for name, robot_model, pairs, obstacles, limits in settings:
        speed = robot_model.tool_speed.value if name == "speed" else None
        log, u_nom, rows, iterations = record_episode(robot_model, obstacles, limits=limits, speed=speed)
        safety = make_filter(robot_model, obstacles, limits=limits, speed=speed)
        records.append(
            {
                "setting": name,
                "pairs": pairs,
                "obstacles": obstacles,
                "rows": round(rows, 1),
                "iterations": round(iterations, 3),
                "c_warm_us": 1e6 * c_time(safety, log, u_nom, cold=False),
                "c_cold_us": 1e6 * c_time(safety, log, u_nom, cold=True),
                "python_us": 1e6 * python_time(safety, log, u_nom),
            }
        )
    return records


def draw_ratio(records, path):
    """Draw the ratio of the step time with the Cartesian speed limit to that without it, by the number of obstacles."""
    from dualbrain.visualization.html.plot_style import image_figure  # noqa: PLC0415  (only for the figure)

    plain, limited = ([r for r in records if r["setting"] == name] for name in ("shipped", "speed"))
    with image_figure(path, 4.4) as figure:
        axes = figure.subplots()
        for key, label in (("c_warm_us", "C, warm"), ("c_cold_us", "C, cold"), ("python_us", "from Python")):
            ratios = [b[key] / a[key] for a, b in zip(plain, limited, strict=True)]
            axes.plot([r["obstacles"] for r in plain], ratios, marker="o", label=label)
        axes.axhline(1.0, color="black", linewidth=0.6)
        axes.set(xscale="log", xlabel="obstacles", ylabel="step time with / without\nspeed limit", ylim=(0.0, None))
        axes.legend()


def main() -> None:
    """Print a table, or one JSON object with `--json`; draw the ratio with `--figure`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--figure", metavar="FILE", help="draw the ratio with and without the speed limit")
    options, records = parser.parse_args(), measure()
    if options.figure:
        draw_ratio(records, options.figure)
    if options.json:
        json.dump(
            {"kernel": kernel_hash(), "machine": platform.processor() or platform.machine(), "steps": records},
            sys.stdout,
        )
        print()
        return
    print(f"kernel {kernel_hash()}\n{'setting':>8} {'pairs':>6} {'rows':>6} {'iter':>6}   C warm  C cold  Python  [us]")
    for r in records:
        print(
            f"{r['setting']:>8} {r['pairs']:>6} {r['rows']:>6} {r['iterations']:>6}  "
            f"{r['c_warm_us']:7.2f} {r['c_cold_us']:7.2f} {r['python_us']:7.2f}"
        )


if __name__ == "__main__":
    main()
