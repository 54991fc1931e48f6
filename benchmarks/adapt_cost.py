"""What a step of fitting costs: ours plain, ours with the whole objective, and TRL's trainer, on the same samples.

    python benchmarks/adapt_cost.py [--steps 12] [--batch 8] [--trl PYTHON]

Each lives in a process of its own, so that its memory is its own; they take turns, one step each, in an order that
rotates, so that they share whatever else the machine does. A step is counted in processor seconds (user and system):
on a machine that others use too, these and their ratios mean something, wall time does not. The first two steps of
each are not counted. TRL comes from an environment of its own (`--trl`), for its needs are not ours;
benchmarks/trl/requirements.txt says how to make it.
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
from dualbrain.cli.common import paths

VARIANTS = ("ours, plain", "ours, whole objective", "TRL SFTTrainer")
BASE, WARM_UP_STEPS = "smollm2-135m-instruct", 2


def main() -> int:
    """Print one table."""
    asked = parse()
    if asked.variant:
        run_variant(asked)
        return 0
    names = VARIANTS if asked.trl else VARIANTS[:2]
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data.json"
        data.write_bytes(msgspec.json.encode(make_dataset(asked)))
        workers = {name: VariantProcess(name, asked, data) for name in names}
        told: dict[str, list[dict[str, float]]] = {name: [] for name in names}
        for turn in range(asked.steps + WARM_UP_STEPS):
            for name in (*names[turn % len(names) :], *names[: turn % len(names)]):
                told[name].append(workers[name].step())
        for worker in workers.values():
            worker.close()
    print("\n".join(report({name: rows[WARM_UP_STEPS:] for name, rows in told.items()})))
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=12, help="counted steps of each (default 12)")
    parser.add_argument("--batch", type=int, default=8, help="samples a step (default 8)")
    parser.add_argument("--threads", type=int, default=1, help="threads of each (default 1)")
    parser.add_argument("--trl", help="a Python that has trl, torch, transformers, peft and what dualbrain needs")
    parser.add_argument("--variant", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def make_dataset(asked: argparse.Namespace) -> Dataset:
    """As many lessons as the steps need."""
    from dualbrain.grounding.vocabulary import load_skill_registry  # noqa: PLC0415
    from dualbrain.runtime.data_collection.synthetic_scenes import ROBOT_SHARES, generate_examples  # noqa: PLC0415  (not in the process that only fits)

    rows = generate_examples((asked.steps + WARM_UP_STEPS) * asked.batch, "teach")
    return build_synthetic_dataset(rows, (), {robot: load_skill_registry(robot) for robot in ROBOT_SHARES})


def report(told: dict[str, list[dict[str, float]]]) -> list[str]:
    """Medians, and ratios to the first."""
    first = median(row["cpu"] for row in told[VARIANTS[0]])
    lines = ["| | CPU-s a step (median) | to plain | wall s a step | peak memory |", "|---|---|---|---|---|"]
    for name, rows in told.items():
        cpu, wall = (median(row[what] for row in rows) for what in ("cpu", "wall"))
        lines.append(f"| {name} | {cpu:.2f} | {cpu / first:.2f} | {wall:.1f} | {rows[-1]['peak_mb']:.0f} MB |")
    return lines


class VariantProcess:
    """One variant in its own process, which takes a step when it is told to."""

    def __init__(self, name: str, asked: argparse.Namespace, data: Path) -> None:
        python = asked.trl if name == VARIANTS[2] else sys.executable
        command = [python, str(Path(__file__).resolve()), "--variant", name, "--data", str(data)]
        command += ["--steps", str(asked.steps), "--batch", str(asked.batch), "--threads", str(asked.threads)]
        path = os.pathsep.join(one for one in sys.path if one)
        environ = os.environ | {"OMP_NUM_THREADS": str(asked.threads), "HF_HUB_OFFLINE": "1"}
        environ |= {} if name == VARIANTS[2] else {"PYTHONPATH": path}
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environ)
        self._request("")

    def step(self) -> dict[str, float]:
        """Processor seconds, wall seconds and peak memory [MB] of the next step."""
        return self._request("go\n")

    def close(self) -> None:
        """Let it end."""
        self._process.kill()
        self._process.wait()

    def _request(self, word: str) -> dict[str, float]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(word)
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith('{"cpu"'):
                return json.loads(line)
        raise RuntimeError(f"{self._process.args} ended with {self._process.wait()}")


class StepBarrier:
    """Waits for its turn before each step, and tells what the step before cost."""

    def __init__(self) -> None:
        self._start_times: tuple[float, float] = (0.0, 0.0)

    def ready(self) -> None:
        """Everything is loaded; wait for the first turn."""
        self._report_step(0.0, 0.0)

    def step_done(self, *_: Any) -> None:
        """A step is over; wait for the next turn."""
        cpu, wall = time.process_time() - self._start_times[0], time.monotonic() - self._start_times[1]
        self._report_step(cpu, wall)

    def _report_step(self, cpu: float, wall: float) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps({"cpu": cpu, "wall": wall, "peak_mb": peak}), flush=True)
        sys.stdin.readline()
        self._start_times = (time.process_time(), time.monotonic())


def run_variant(asked: argparse.Namespace) -> None:
    """The life of one variant."""
    import torch  # noqa: PLC0415

    torch.set_num_threads(asked.threads)
    dataset = msgspec.json.decode(asked.data.read_bytes(), type=Dataset)
    objective = ObjectiveConfig() if asked.variant == VARIANTS[1] else SYNTHETIC_ADAPT_CONFIG.objective
    steps = asked.steps + WARM_UP_STEPS
    fit = FitConfig(steps=steps, batch=asked.batch, at_once=asked.batch, save_every=steps, ask_at_most=0)
    life: Callable[[Dataset, AdaptConfig, StepBarrier], None] = (
        train_with_trl if asked.variant == VARIANTS[2] else train_with_dualbrain
    )
    life(dataset, AdaptConfig(objective=objective, fit=fit), StepBarrier())


def train_with_dualbrain(dataset: Dataset, config: AdaptConfig, turns: StepBarrier) -> None:
    """Our own loop."""
    from dualbrain.adaptation.training.model.base_model import load_base_model  # noqa: PLC0415
    from dualbrain.adaptation.training.model.lora_model import LoraModel  # noqa: PLC0415
    from dualbrain.adaptation.training.model.precision import choose_dtype  # noqa: PLC0415
    from dualbrain.adaptation.training.trainer import Trainer  # noqa: PLC0415

    base = find_base_model(BASE, paths.cache_folder())
    learner = LoraModel(*load_base_model(base, paths.cache_folder(), choose_dtype("auto")), config.fit)
    with tempfile.TemporaryDirectory() as folder:
        fit = Trainer(
            learner, dataset, config, make_language_judge({}), Path(folder), base=base.sha256, clock=time.monotonic
        )
        turns.ready()
        fit.run(turns.step_done)


def train_with_trl(dataset: Dataset, config: AdaptConfig, turns: StepBarrier) -> None:
    """TRL's trainer with the same adapter, precision, rate and tokens."""
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
    some = [encode_sample(learner.tokenizer, one, learner.max_tokens) for one in dataset.train]
    rows = [
        {"input_ids": [*one.prompt, *one.contract], "completion_mask": [0] * len(one.prompt) + [1] * len(one.contract)}
        for one in some
    ]
    fit = config.fit
    shape = trl.SFTConfig(
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
            turns.ready()

        def on_step_end(self, *_: Any, **__: Any) -> None:
            turns.step_done()

    trl.SFTTrainer(
        model=learner.model,
        args=shape,
        train_dataset=datasets.Dataset.from_list(rows),
        processing_class=learner.tokenizer,
        callbacks=[Handshake()],
    ).train()


if __name__ == "__main__":
    sys.exit(main())
