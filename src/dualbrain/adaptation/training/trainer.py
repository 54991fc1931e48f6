"""Fitting an adapter: steps along the objective, checkpoints, and a stop when held-out answers get no better."""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from dualbrain.adaptation.compliance import AnswerJudge, compliant_share
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.adaptation.early_stopping import EarlyStopping, HeldOutResult
from dualbrain.adaptation.training.checkpoint import (
    CheckpointState,
    RunKey,
    load_best,
    load_checkpoint,
    save_best,
    save_checkpoint,
)
from dualbrain.adaptation.training.master_weights import MasterWeights
from dualbrain.adaptation.training.model.batching import EncodedSample, collate, contract_hidden_states
from dualbrain.adaptation.training.model.lora_model import LoraModel
from dualbrain.adaptation.training.objective import Loss, log_probabilities, objective
from dualbrain.adaptation.training.prepared_data import prepare_data
from dualbrain.adaptation.training.process_group import SINGLE_PROCESS, ProcessGroup
from dualbrain.adaptation.training.schedule import learning_rate, plan_batches
from dualbrain.errors import ConfigurationError, DualbrainError

CHECKPOINT_FILE, BEST_FILE, STATES_FILE = "checkpoint.safetensors", "best.safetensors", "base_states.safetensors"
MAX_LENGTH_RATIO = 1.5
"""A free answer may be this many times as long as the longest contract that was taught."""


class TrainingDivergedError(DualbrainError):
    """Loss or gradient stopped being a number; the last checkpoint is from before."""

    def __init__(self, step: int, quantity: str) -> None:
        """Name the step, and what was no number."""
        self.step, self.quantity = step, quantity
        super().__init__(
            f"the {quantity} of step {step} is not finite. Nothing of this step was kept. Lower `[fit] rate`, or set "
            f'`precision = "float32"`, and name another --out: a folder keeps to its dials.'
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """How far a fit is: mean cross-entropy and divergence of the last step [nats/token], time left [s] at its pace."""

    step: int
    steps: int
    cross_entropy: float
    divergence: float
    seconds_left: float
    held_out: HeldOutResult | None


class Trainer:
    """One fit in one folder. Run again after any interruption, it ends as if it had never been interrupted.

    Promise: the result is a function of data, dials and base alone, on one machine with one number of threads and of
    processes; it does not depend on when or how often they were killed. No step is kept whose loss was not a number.

    In a team each process computes a share of every step's samples; loss and gradients are summed, so all take the same
    step, and as many processes as there may be, it is that of one up to rounding. The first one alone asks what is held
    out, and writes.
    """

    def __init__(
        self,
        lora_model: LoraModel,
        dataset: Dataset,
        config: AdaptConfig,
        judge: AnswerJudge,
        folder: Path,
        *,
        base: str,
        clock: Callable[[], float],
        process_group: ProcessGroup = SINGLE_PROCESS,
    ) -> None:
        """Begin, or go on where the checkpoint in `folder` stands; `clock` [s] only tells the time left.

        `base` is the hash of what `learner` was. Raises `InvalidSetup` if a process of the team would have nothing to
        do, for what `prepare` cannot teach, and for a checkpoint of another run; then nothing in `folder` has changed.
        """
        if config.fit.batch < process_group.size:
            raise ConfigurationError(
                "fit batch", got=config.fit.batch, allowed=f"a sample for each of {process_group.size} processes"
            )
        self._lora_model, self._held_out_samples = lora_model, dataset.held_out
        self._config, self._judge, self._folder, self._clock = config, judge, folder, clock
        self._run_key = RunKey(
            data=dataset.card.hash,
            base=base,
            number_format=lora_model.number_format,
            objective=config.objective,
            fit=config.fit,
        )
        found = load_checkpoint(folder / CHECKPOINT_FILE, self._run_key)
        self._data = prepare_data(lora_model, dataset, config.objective, base, folder / STATES_FILE, process_group)
        self._process_group, self._master_weights = process_group, MasterWeights(lora_model.parameters, process_group)
        self._batches = plan_batches(self._data.repeats, config.fit)
        self.step, self.early_stopping, self._best_sha256 = 0, EarlyStopping(), ""
        if found:
            mark, tensors = found
            self._master_weights.load_state_dict(tensors)
            self.step, self.early_stopping, self._best_sha256 = mark.step, mark.patience, mark.best

    @property
    def is_finished(self) -> bool:
        """Whether all steps are taken, or nothing got better for long enough."""
        return self.step >= self._config.fit.steps or self.early_stopping.waited >= self._config.fit.patience

    def run(self, report: Callable[[TrainingProgress], None] = lambda progress: None) -> HeldOutResult | None:
        """Take all steps that are left and wear the best adapter; returns its held-out result, None without that part.

        Raises `Diverged`, `DiskFull`, and `InvalidSetup` if the best is not any more what it was when it was examined.
        """
        dials, first, began = self._config.fit, self.step, self._clock()
        while not self.is_finished:
            cross_entropy, divergence = self._train_step(self.step + 1)
            self.step += 1
            found = None
            last = self.step == dials.steps
            if last or self.step % dials.save_every == 0:
                found = self._evaluate() if last or dials.keep == "best" else None
                self._process_group.run_on_first(self._save_checkpoint)
            pace = (self._clock() - began) / (self.step - first)
            left = pace * (dials.steps - self.step)
            report(
                TrainingProgress(
                    step=self.step,
                    steps=dials.steps,
                    cross_entropy=cross_entropy,
                    divergence=divergence,
                    seconds_left=left,
                    held_out=found,
                )
            )
        self._lora_model.load_adapter(load_best(self._folder / BEST_FILE, self._best_sha256))
        return self.early_stopping.best

    def _train_step(self, step: int) -> tuple[float, float]:
        """One optimiser step; its mean cross-entropy and divergence [nats/token]."""
        dials, rows = self._config.fit, self._sort_by_length(self._batches[step - 1])
        tokens = sum(len(self._data.train[row].contract) for row in rows)
        mine = rows[self._process_group.rank :: self._process_group.size]
        told = torch.zeros(3, dtype=torch.float64, device=self._lora_model.head.device)
        for start in range(0, len(mine), dials.at_once):
            loss = self._micro_batch_loss(mine[start : start + dials.at_once], tokens)
            loss.total.backward()
            told += torch.stack([value.detach() for value in loss])
        self._process_group.all_reduce_sum([told])
        total, cross_entropy, divergence = told.tolist()
        if not math.isfinite(total):
            raise TrainingDivergedError(step, f"loss ({total})")
        norm = self._master_weights.step(learning_rate(step, dials), dials.clip)
        if not math.isfinite(norm):
            raise TrainingDivergedError(step, f"gradient ({norm})")
        return cross_entropy, divergence

    def _sort_by_length(self, rows: Sequence[int]) -> list[int]:
        """`rows` with the shortest first: samples that are computed together then need little padding."""
        train = self._data.train
        return sorted(rows, key=lambda row: len(train[row].prompt) + len(train[row].contract))

    def _micro_batch_loss(self, rows: Sequence[int], tokens: int) -> Loss:
        """The share that some samples have in the loss of a step of `tokens` tokens."""
        dials, learner = self._config.objective, self._lora_model
        some = [self._data.train[row] for row in rows]
        batch = collate(some, learner.padding_id, device=str(learner.head.device))
        hidden, labels = contract_hidden_states(learner.decoder, batch)
        counts = torch.tensor(batch.contract_token_counts)
        weights = torch.tensor(self._data.omega[list(rows)], dtype=torch.float32).repeat_interleave(counts)
        return objective(
            hidden,
            learner.head,
            labels,
            weights.to(learner.head.device),
            tokens,
            beta=dials.beta,
            base_hidden=self._data.reference_states.hidden_states(some) if self._data.reference_states else None,
            token_gate=dials.entropy_gate == "token",
        )

    def _evaluate(self) -> HeldOutResult | None:
        """Ask what is held out; keep the adapter if it is the best so far, or if there is nothing to ask."""
        found = None
        if self._data.held_out:
            found = self._process_group.run_on_first(
                lambda: HeldOutResult(self.step, self._compute_compliance(), self._compute_held_out_loss())
            )
            if not math.isfinite(found.loss):
                raise TrainingDivergedError(self.step, f"held-out loss ({found.loss})")
            self.early_stopping = (
                EarlyStopping(found) if self._config.fit.keep == "last" else self.early_stopping.updated(found)
            )
        if found is None or self.early_stopping.best == found:
            self._best_sha256 = self._process_group.run_on_first(
                lambda: save_best(self._folder / BEST_FILE, self._lora_model.adapter_tensors())
            )
        return found

    def _save_checkpoint(self) -> None:
        """Write the checkpoint."""
        mark = CheckpointState(
            run=self._run_key.digest,
            step=self.step,
            patience=self.early_stopping,
            best=self._best_sha256,
            run_parts=self._run_key.parts,
        )
        save_checkpoint(self._folder / CHECKPOINT_FILE, mark, self._master_weights.state_dict())

    def _compute_compliance(self) -> float | None:
        """The share of sound free answers to some held-out questions, evenly chosen; None if none is to be asked."""
        every = self._data.held_out
        count = min(len(every), self._config.fit.ask_at_most)
        if not count:
            return None
        rows = [i * len(every) // count for i in range(count)]
        most = int(MAX_LENGTH_RATIO * max(len(one.contract) for one in self._data.train))
        answers: list[str] = []
        for start in range(0, count, self._config.fit.at_once):
            some = [every[row].prompt for row in rows[start : start + self._config.fit.at_once]]
            answers += self._lora_model.generate_answers(some, most)
        return compliant_share(self._judge, answers, [self._held_out_samples[row] for row in rows])

    @torch.no_grad()
    def _compute_held_out_loss(self) -> float:
        """Mean cross-entropy over the contract tokens of all that is held out [nats/token]."""
        total, tokens, every = 0.0, 0, self._data.held_out
        for start in range(0, len(every), self._config.fit.at_once):
            some: Sequence[EncodedSample] = every[start : start + self._config.fit.at_once]
            batch = collate(some, self._lora_model.padding_id, device=str(self._lora_model.head.device))
            hidden, labels = contract_hidden_states(self._lora_model.decoder, batch)
            log_p = log_probabilities(hidden, self._lora_model.head)
            total -= float(log_p.gather(1, labels[:, None]).sum())
            tokens += len(labels)
        return total / tokens
