"""Cost of a training step: dualbrain with the plain loss, dualbrain with the whole objective, and the trainer of TRL.

    python -m benchmarks.adapt_cost [--steps 12] [--batch 8] [--trl PYTHON]

All variants train on the same samples. Each runs in a separate process, so that its peak memory is its own. They
alternate step by step in a rotating order, so that other load on the machine affects all of them. Costs are processor
seconds (user and system), which other load distorts less than wall time. The first two steps of each are not counted.
TRL runs in a separate environment (`--trl`); benchmarks/trl/requirements.txt describes its installation.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.base_models import find_base_model
from dualbrain.adaptation.config import AdaptConfig, FitConfig, ObjectiveConfig
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.adaptation.synthetic.dataset import SYNTHETIC_ADAPT_CONFIG, build_synthetic_dataset, make_language_judge
from dualbrain.core import paths

VARIANTS = ("dualbrain, plain loss", "dualbrain, whole objective", "TRL SFTTrainer")
BASE, WARM_UP_STEPS = "smollm2-135m-instruct", 2


def main() -> int:
    """Print one table."""
    options = parse()
    if options.variant:
        run_variant(options)
        return 0
    names = VARIANTS if options.trl else VARIANTS[:2]
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data.json"
        data.write_bytes(msgspec.json.encode(make_dataset(options)))
        workers = {name: VariantProcess(name, options, data) for name in names}
        costs: dict[str, list[dict[str, float]]] = {name: [] for name in names}
        for turn in range(options.steps + WARM_UP_STEPS):
            for name in (*names[turn % len(names) :], *names[: turn % len(names)]):
                costs[name].append(workers[name].step())
        for worker in workers.values():
            worker.close()
    print("\n".join(report({name: rows[WARM_UP_STEPS:] for name, rows in costs.items()})))
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=12, help="counted steps of each variant (default 12)")
    parser.add_argument("--batch", type=int, default=8, help="samples per step (default 8)")
    parser.add_argument("--threads", type=int, default=1, help="threads of each variant (default 1)")
    parser.add_argument(
        "--trl", help="Python interpreter with trl, torch, transformers, peft and the requirements of dualbrain"
    )
    parser.add_argument("--variant", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def make_dataset(options: argparse.Namespace) -> Dataset:
    """Return as many synthetic samples as the steps need."""
    from dualbrain.grounding.vocabulary import load_skill_registry  # noqa: PLC0415
    from dualbrain.runtime.data_collection.synthetic_scenes import ROBOT_SHARES, generate_examples  # noqa: PLC0415

    rows = generate_examples((options.steps + WARM_UP_STEPS) * options.batch, "teach")
    return build_synthetic_dataset(rows, (), {robot: load_skill_registry(robot) for robot in ROBOT_SHARES})


def report(costs: dict[str, list[dict[str, float]]]) -> list[str]:
    """Return a table of medians and of ratios to the first variant."""
    first = median(row["cpu"] for row in costs[VARIANTS[0]])
    lines = ["| | CPU s per step (median) | ratio to plain | wall s per step | peak memory |", "|---|---|---|---|---|"]
    for name, rows in costs.items():
        cpu, wall = (median(row[key] for row in rows) for key in ("cpu", "wall"))
        lines.append(f"| {name} | {cpu:.2f} | {cpu / first:.2f} | {wall:.1f} | {rows[-1]['peak_mb']:.0f} MB |")
    return lines


class VariantProcess:
    """One variant in a separate process, which takes a step on request."""

    def __init__(self, name: str, options: argparse.Namespace, data: Path) -> None:
        python = options.trl if name == VARIANTS[2] else sys.executable
        command = [python, str(Path(__file__).resolve()), "--variant", name, "--data", str(data)]
        command += ["--steps", str(options.steps), "--batch", str(options.batch), "--threads", str(options.threads)]
        path = os.pathsep.join(one for one in sys.path if one)
        environ = os.environ | {"OMP_NUM_THREADS": str(options.threads), "HF_HUB_OFFLINE": "1"}
        environ |= {} if name == VARIANTS[2] else {"PYTHONPATH": path}
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environ)
        self._request("")

    def step(self) -> dict[str, float]:
        """Take a step; returns processor seconds, wall seconds and peak memory [MB]."""
        return self._request("go\n")

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()

    def _request(self, line: str) -> dict[str, float]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(line)
        self._process.stdin.flush()
        for answer in self._process.stdout:
            if answer.startswith('{"cpu"'):
                return json.loads(answer)
        raise RuntimeError(f"{self._process.args} ended with {self._process.wait()}")


class StepBarrier:
    """Reports the cost of the previous step and waits for the request of the next one."""

    def __init__(self) -> None:
        self._start_times: tuple[float, float] = (0.0, 0.0)

    def ready(self) -> None:
        """Report that everything is loaded, and wait for the first request."""
        self._report_step(0.0, 0.0)

    def step_done(self, *_: Any) -> None:
        """Report the cost of the finished step, and wait for the next request."""
        cpu, wall = time.process_time() - self._start_times[0], time.monotonic() - self._start_times[1]
        self._report_step(cpu, wall)

    def _report_step(self, cpu: float, wall: float) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps({"cpu": cpu, "wall": wall, "peak_mb": peak}), flush=True)
        sys.stdin.readline()
        self._start_times = (time.process_time(), time.monotonic())


def run_variant(options: argparse.Namespace) -> None:
    """Train with one variant; runs in its process."""
    import torch  # noqa: PLC0415

    torch.set_num_threads(options.threads)
    dataset = msgspec.json.decode(options.data.read_bytes(), type=Dataset)
    objective = ObjectiveConfig() if options.variant == VARIANTS[1] else SYNTHETIC_ADAPT_CONFIG.objective
    steps = options.steps + WARM_UP_STEPS
    fit = FitConfig(steps=steps, batch=options.batch, at_once=options.batch, save_every=steps, ask_at_most=0)
    train: Callable[[Dataset, AdaptConfig, StepBarrier], None] = (
        train_with_trl if options.variant == VARIANTS[2] else train_with_dualbrain
    )
    train(dataset, AdaptConfig(objective=objective, fit=fit), StepBarrier())


def train_with_dualbrain(dataset: Dataset, config: AdaptConfig, barrier: StepBarrier) -> None:
    """Train with the trainer of dualbrain."""
    from dualbrain.adaptation.training.model.base_model import load_base_model  # noqa: PLC0415
    from dualbrain.adaptation.training.model.lora_model import LoraModel  # noqa: PLC0415
    from dualbrain.adaptation.training.model.precision import choose_dtype  # noqa: PLC0415
    from dualbrain.adaptation.training.trainer import Trainer  # noqa: PLC0415

    base = find_base_model(BASE, paths.cache_folder())
    learner = LoraModel(*load_base_model(base, paths.cache_folder(), choose_dtype("auto")), config.fit)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            learner, dataset, config, make_language_judge({}), Path(folder), base=base.sha256, clock=time.monotonic
        )
        barrier.ready()
        trainer.run(barrier.step_done)


def train_with_trl(dataset: Dataset, config: AdaptConfig, barrier: StepBarrier) -> None:
    """Train with TRL, with the same adapter, precision, learning rate and tokens."""
    import datasets  # noqa: PLC0415
    import trl  # noqa: PLC0415
    from transformers import TrainerCallback  # noqa: PLC0415

    from dualbrain.adaptation.training.model.base_model import load_base_model  # noqa: PLC0415
    from dualbrain.adaptation.training.model.batching import encode_sample  # noqa: PLC0415
    from dualbrain.adaptation.training.model.lora_model import LoraModel  # noqa: PLC0415
    from dualbrain.adaptation.training.model.precision import choose_dtype  # noqa: PLC0415

    learner = LoraModel(
        *load_base_model(find_base_model(BASE, paths.cache_folder()), paths.cache_folder(), choose_dtype("auto")),
        config.fit,
    )
    samples = [encode_sample(learner.tokenizer, one, learner.max_tokens) for one in dataset.train]
    rows = [
        {"input_ids": [*one.prompt, *one.contract], "completion_mask": [0] * len(one.prompt) + [1] * len(one.contract)}
        for one in samples
    ]
    fit = config.fit
    arguments = trl.SFTConfig(
        output_dir=tempfile.mkdtemp(),
        max_steps=fit.steps,
        per_device_train_batch_size=fit.batch,
        learning_rate=fit.rate,
        weight_decay=0.0,
        max_grad_norm=fit.clip,
        optim="adamw_torch",
        save_strategy="no",
        logging_strategy="no",
        report_to="none",
        use_cpu=True,
        bf16=False,
        gradient_checkpointing=False,
        completion_only_loss=True,
        max_length=None,
        disable_tqdm=True,
    )

    class Handshake(TrainerCallback):
        def on_train_begin(self, *_: Any, **__: Any) -> None:
            barrier.ready()

        def on_step_end(self, *_: Any, **__: Any) -> None:
            barrier.step_done()

    trl.SFTTrainer(
        model=learner.model,
        args=arguments,
        train_dataset=datasets.Dataset.from_list(rows),
        processing_class=learner.tokenizer,
        callbacks=[Handshake()],
    ).train()


if __name__ == "__main__":
    sys.exit(main())
