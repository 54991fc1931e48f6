"""A small network that imitates the careful policy: posture, goal and obstacles in, direction of the path out.

It is trained here on planned paths of other scenes (behaviour cloning, squared error) and stored below build/. Like
every imitation policy it has no guarantee: it also leaves the path where its demonstrations do not show the way.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import nn

from benchmarks.guards.policies import CAREFUL_SPEED, PERIOD, speed_limits, step_towards
from benchmarks.guards.scene import MAX_OBSTACLES, GuardScene, make_scene
from dualbrain.core.geometry.shapes import Box, Capsule, Sphere
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.safety.reference_judge import rotation_matrix

Array = NDArray[np.float64]

N_TRAINING_SCENES, FIRST_TRAINING_SEED = 400, 1_000_000
LOOK_AHEAD = 4
"""The direction points to the posture this many points of the path ahead."""
NOISE, COPIES = 0.05, 4
"""Standard deviation [rad] of the postures beside the path that are demonstrated, and their number per posture."""
N_STEPS, BATCH, WIDTH, LEARNING_RATE = 4000, 512, 256, 1e-3
STRAIGHT_DISTANCE = 0.25
"""Distance of every joint from the goal below which the policy goes straight to it [rad]."""
WEIGHTS = Path(__file__).resolve().parents[2] / "build" / "guards" / "policy.safetensors"


class LearnedPolicy:
    """The trained network at the speed of its demonstrations."""

    def __init__(self, scene: GuardScene, rng: np.random.Generator) -> None:
        del rng
        self._network, self._speed = load_network(), CAREFUL_SPEED * speed_limits()
        self._goal, self._obstacles = scene.goal, describe_obstacles(scene.obstacles)

    def act(self, q: Array) -> Array:
        """One step in the predicted direction; the last part of the way leads straight to the goal."""
        if np.all(np.abs(self._goal - q) <= STRAIGHT_DISTANCE):
            return step_towards(q, self._goal, self._speed)
        with torch.inference_mode():
            direction = self._network(_features(q[None], self._goal, self._obstacles)).numpy()[0].astype(float)
        return q + PERIOD * direction / max(float(np.max(np.abs(direction) / self._speed)), 1e-9)


def describe_obstacles(obstacles: tuple[Obstacle, ...]) -> Array:
    """Centre and half extents along the world's axes [m] of each obstacle but the table, zeros without one."""
    found = np.zeros((MAX_OBSTACLES, 6))
    for row, obstacle in zip(found, obstacles[1:], strict=False):
        row[:3], row[3:] = obstacle.pose.position, _half_extents(obstacle)
    return found.ravel()


def _half_extents(obstacle: Obstacle) -> Array:
    turn = np.abs(rotation_matrix(obstacle.pose.quaternion))
    match obstacle.shape:
        case Sphere(radius=radius):
            return np.full(3, radius)
        case Capsule(radius=radius, half_length=length):
            return turn[:, 2] * length + radius
        case Box(half_extents=extents):
            return turn @ np.array(extents)
        case _:
            raise ValueError(f"the benchmark has no obstacle of this shape: {obstacle.shape}")


@cache
def load_network() -> nn.Module:
    """The trained network; the first process trains it, the others wait."""
    torch.set_num_threads(1)
    network = _make_network()
    WEIGHTS.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(WEIGHTS.with_suffix(".lock")):
        if not WEIGHTS.exists():
            save_file(_train(network).state_dict(), WEIGHTS)
    network.load_state_dict(load_file(WEIGHTS))
    return network.eval()


def _make_network() -> nn.Sequential:
    torch.manual_seed(0)
    size = 21 + 6 * MAX_OBSTACLES
    return nn.Sequential(nn.Linear(size, WIDTH), nn.GELU(), nn.Linear(WIDTH, WIDTH), nn.GELU(), nn.Linear(WIDTH, 7))


def _train(network: nn.Module) -> nn.Module:
    inputs, outputs = _demonstrations()
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, N_STEPS)
    generator = torch.Generator().manual_seed(0)
    for step in range(N_STEPS):
        chosen = torch.randint(len(inputs), (BATCH,), generator=generator)
        loss = nn.functional.mse_loss(network(inputs[chosen]), outputs[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 500 == 0:
            print(f"learned policy: step {step} of {N_STEPS}, loss {loss.item():.4f}", file=sys.stderr)
    return network


def _demonstrations() -> tuple[torch.Tensor, torch.Tensor]:
    """Features, and unit directions, on the paths of the training scenes and beside them."""
    rng, inputs, outputs = np.random.default_rng(0), list[torch.Tensor](), list[Array]()
    for seed in range(FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + N_TRAINING_SCENES):
        scene = make_scene(seed)
        ahead = scene.path[np.minimum(np.arange(len(scene.path)) + LOOK_AHEAD, len(scene.path) - 1)]
        for copy in range(COPIES):
            q = scene.path + (rng.normal(0.0, NOISE, scene.path.shape) if copy else 0.0)
            inputs.append(_features(q, scene.goal, describe_obstacles(scene.obstacles)))
            outputs.append((ahead - q) / (np.abs(ahead - q).max(axis=1, keepdims=True) + 1e-3))
    return torch.cat(inputs), torch.from_numpy(np.concatenate(outputs)).float()


def _features(q: Array, goal: Array, obstacles: Array) -> torch.Tensor:
    rest = np.tile(np.concatenate([goal, obstacles]), (len(q), 1))
    return torch.from_numpy(np.concatenate([q, goal - q, rest], axis=1)).float()
