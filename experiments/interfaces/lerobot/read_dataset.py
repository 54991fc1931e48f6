"""Reads a dataset with LeRobot's own classes, compares its statistics with LeRobot's own, and trains an ACT from it.

Runs in the environment of `virtual_environment`: python read_dataset.py FOLDER OUT [STEPS]

Writes OUT/report.json and OUT/frames.npz (every column as LeRobot returns it).
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

REPOSITORY = "local/dualbrain"
CHUNK, BATCH = 10, 8


def read_columns(dataset):
    """Every column of the dataset over all frames, as arrays."""
    frames = dataset.hf_dataset.with_format("numpy")
    return {name: np.stack([np.asarray(value) for value in frames[name]]) for name in dataset.features}


def statistics_difference(dataset, columns):
    """Largest difference of a stored statistic from LeRobot's own: (of an episode, of the whole dataset)."""
    import pyarrow.parquet as pq  # noqa: PLC0415

    stored = pq.read_table(Path(dataset.root) / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    episodes, worst = [], 0.0
    for number, row in enumerate(stored):
        chosen = columns["episode_index"] == number
        own = compute_episode_stats({name: values[chosen] for name, values in columns.items()}, dataset.features)
        episodes.append(own)
        for feature, values in own.items():
            for key, value in values.items():
                found = np.asarray(row[f"stats/{feature}/{key}"], np.float64)
                worst = max(worst, float(np.abs(found - np.asarray(value, np.float64)).max()))
    whole = aggregate_stats(episodes)
    assert set(whole) == set(dataset.meta.stats)
    differences = [
        float(np.abs(np.asarray(dataset.meta.stats[feature][key], np.float64) - value).max())
        for feature, values in whole.items()
        for key, value in values.items()
    ]
    return worst, max(differences)


def train_act(folder, fps, steps):
    """Loss of each step of a small ACT that predicts actions from the joint positions."""
    torch.manual_seed(0)
    metadata = LeRobotDataset(REPOSITORY, root=folder).meta
    features = dataset_to_policy_features(metadata.features)
    features = {name: feature for name, feature in features.items() if name in ("observation.state", "action")}
    # ACT needs an image or the state of the environment; the joint positions are given as both
    environment = type(features["observation.state"])(type=FeatureType.ENV, shape=features["observation.state"].shape)
    inputs = {"observation.state": features["observation.state"], "observation.environment_state": environment}
    small = {"dim_model": 64, "n_heads": 4, "dim_feedforward": 128, "n_encoder_layers": 2, "latent_dim": 8}
    config = ACTConfig(
        input_features=inputs,
        output_features={"action": features["action"]},
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        device="cpu",
        **small,
    )
    statistics = dict(metadata.stats)
    statistics["observation.environment_state"] = statistics["observation.state"]
    policy = ACTPolicy(config)
    prepare, _ = make_pre_post_processors(config, dataset_stats=statistics)
    deltas = {"observation.state": [0.0], "action": [step / fps for step in range(CHUNK)]}
    dataset = LeRobotDataset(REPOSITORY, root=folder, delta_timestamps=deltas)
    loader = torch.utils.data.DataLoader(dataset, batch_size=BATCH, shuffle=True)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
    losses = []
    while len(losses) < steps:
        for batch in loader:
            batch["observation.state"] = batch["observation.state"].squeeze(1)
            batch["observation.environment_state"] = batch["observation.state"]
            loss, _ = policy.forward(prepare(batch))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
            if len(losses) >= steps:
                break
    return losses


def main(folder, out, steps):
    dataset = LeRobotDataset(REPOSITORY, root=folder)
    columns = read_columns(dataset)
    of_episodes, of_dataset = statistics_difference(dataset, columns)
    report = {
        "frames": len(dataset),
        "lengths": [int(row["length"]) for row in dataset.meta.episodes],
        "tasks": dataset.meta.tasks.index.tolist(),
        "frame_tasks": [dataset[int(row["dataset_from_index"])]["task"] for row in dataset.meta.episodes],
        "tools": dataset.meta.tools,
        "robot_type": dataset.meta.robot_type,
        "fps": dataset.meta.fps,
        "episode_statistics_difference": of_episodes,
        "dataset_statistics_difference": of_dataset,
        "losses": train_act(folder, dataset.meta.fps, steps) if steps else [],
    }
    np.savez(out / "frames.npz", **columns)
    (out / "report.json").write_text(json.dumps(report))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 0)
