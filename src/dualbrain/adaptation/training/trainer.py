"""The training loop: steps along the objective, checkpoints, and early stopping on held-out questions."""

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
"""Maximum length of an unconstrained answer relative to the longest contract in the training data."""


class TrainingDivergedError(DualbrainError):
    """Loss or gradient became infinite or NaN; the last checkpoint is of an earlier step."""

    def __init__(self, step: int, quantity: str) -> None:
        """Report the step and the quantity that is not finite."""
        self.step, self.quantity = step, quantity
        super().__init__(
            f"the {quantity} of step {step} is not finite. This step was discarded. Lower `[fit] rate`, or set "
            f'`precision = "float32"`, and name another --out: a folder belongs to one set of settings.'
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """Progress of a run: mean cross-entropy and divergence of the last step [nats/token], remaining time [s]."""

    step: int
    steps: int
    cross_entropy: float
    divergence: float
    seconds_left: float
    held_out: HeldOutResult | None


class Trainer:
    """One training run in one folder. After any interruption, a new run in the folder gives the same result.

    Promise: the result is a function of data, settings and base alone, on one machine with a fixed number of threads
    and processes; it does not depend on interruptions. No step with a loss that is not finite is kept.

    In a process group each process computes a share of every step's samples. Loss and gradients are summed, so all take
    the same step, which equals that of a single process up to rounding. Only the first process evaluates held-out
    questions and writes files.
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
        """Start, or resume from the checkpoint in `folder`; `clock` [s] is used for the remaining time only.

        `base` is the hash of the base of `lora_model`. Raises `ConfigurationError` if a process would have no sample,
        for data that `prepare_data` rejects, and for a checkpoint of another run; then `folder` is unchanged.
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
            state, tensors = found
            self._master_weights.load_state_dict(tensors)
            self.step, self.early_stopping, self._best_sha256 = state.step, state.patience, state.best

    @property
    def is_finished(self) -> bool:
        """Whether all steps are done, or early stopping ends the run."""
        return self.step >= self._config.fit.steps or self.early_stopping.waited >= self._config.fit.patience

    def run(self, report: Callable[[TrainingProgress], None] = lambda progress: None) -> HeldOutResult | None:
        """Take all remaining steps and load the best adapter; returns its held-out result, None if nothing is held out.

        Raises `TrainingDivergedError`, `FileWriteError`, and `ConfigurationError` if the file of the best adapter was
        changed.
        """
        config, first, start = self._config.fit, self.step, self._clock()
        while not self.is_finished:
            cross_entropy, divergence = self._train_step(self.step + 1)
            self.step += 1
            held_out = None
            last = self.step == config.steps
            if last or self.step % config.save_every == 0:
                held_out = self._evaluate() if last or config.keep == "best" else None
                self._process_group.run_on_first(self._save_checkpoint)
            pace = (self._clock() - start) / (self.step - first)
            seconds_left = pace * (config.steps - self.step)
            report(
                TrainingProgress(
                    step=self.step,
                    steps=config.steps,
                    cross_entropy=cross_entropy,
                    divergence=divergence,
                    seconds_left=seconds_left,
                    held_out=held_out,
                )
            )
        self._lora_model.load_adapter(load_best(self._folder / BEST_FILE, self._best_sha256))
        return self.early_stopping.best

    def _train_step(self, step: int) -> tuple[float, float]:
        """One optimiser step; returns its mean cross-entropy and divergence [nats/token]."""
        config, rows = self._config.fit, self._sort_by_length(self._batches[step - 1])
        tokens = sum(len(self._data.train[row].contract) for row in rows)
        own_rows = rows[self._process_group.rank :: self._process_group.size]
        sums = torch.zeros(3, dtype=torch.float64, device=self._lora_model.head.device)
        for start in range(0, len(own_rows), config.at_once):
            loss = self._micro_batch_loss(own_rows[start : start + config.at_once], tokens)
            loss.total.backward()
            sums += torch.stack([value.detach() for value in loss])
        self._process_group.all_reduce_sum([sums])
        total, cross_entropy, divergence = sums.tolist()
        if not math.isfinite(total):
            raise TrainingDivergedError(step, f"loss ({total})")
        norm = self._master_weights.step(learning_rate(step, config), config.clip)
        if not math.isfinite(norm):
            raise TrainingDivergedError(step, f"gradient ({norm})")
        return cross_entropy, divergence

    def _sort_by_length(self, rows: Sequence[int]) -> list[int]:
        """`rows` with the shortest sample first: samples of one forward pass then need little padding."""
        train = self._data.train
        return sorted(rows, key=lambda row: len(train[row].prompt) + len(train[row].contract))

    def _micro_batch_loss(self, rows: Sequence[int], tokens: int) -> Loss:
        """The share of some samples in the loss of a step with `tokens` tokens."""
        config, lora_model = self._config.objective, self._lora_model
        samples = [self._data.train[row] for row in rows]
        batch = collate(samples, lora_model.padding_id, device=str(lora_model.head.device))
        hidden, labels = contract_hidden_states(lora_model.decoder, batch)
        counts = torch.tensor(batch.contract_token_counts)
        weights = torch.tensor(self._data.omega[list(rows)], dtype=torch.float32).repeat_interleave(counts)
        return objective(
            hidden,
            lora_model.head,
            labels,
            weights.to(lora_model.head.device),
            tokens,
            beta=config.beta,
            base_hidden=self._data.reference_states.hidden_states(samples) if self._data.reference_states else None,
            token_gate=config.entropy_gate == "token",
        )

    def _evaluate(self) -> HeldOutResult | None:
        """Evaluate the held-out part; save the adapter if it is the best so far, or if there is no held-out part."""
        result = None
        if self._data.held_out:
            result = self._process_group.run_on_first(
                lambda: HeldOutResult(self.step, self._compute_compliance(), self._compute_held_out_loss())
            )
            if not math.isfinite(result.loss):
                raise TrainingDivergedError(self.step, f"held-out loss ({result.loss})")
            self.early_stopping = (
                EarlyStopping(result) if self._config.fit.keep == "last" else self.early_stopping.updated(result)
            )
        if result is None or self.early_stopping.best == result:
            self._best_sha256 = self._process_group.run_on_first(
                lambda: save_best(self._folder / BEST_FILE, self._lora_model.adapter_tensors())
            )
        return result

    def _save_checkpoint(self) -> None:
        """Write the checkpoint."""
        state = CheckpointState(
            run=self._run_key.digest,
            step=self.step,
            patience=self.early_stopping,
            best=self._best_sha256,
            run_parts=self._run_key.parts,
        )
        save_checkpoint(self._folder / CHECKPOINT_FILE, state, self._master_weights.state_dict())

    def _compute_compliance(self) -> float | None:
        """The share of compliant answers to evenly chosen held-out questions; None if no question is to be asked."""
        held_out = self._data.held_out
        count = min(len(held_out), self._config.fit.ask_at_most)
        if not count:
            return None
        rows = [i * len(held_out) // count for i in range(count)]
        max_tokens = int(MAX_LENGTH_RATIO * max(len(one.contract) for one in self._data.train))
        answers: list[str] = []
        for start in range(0, count, self._config.fit.at_once):
            prompts = [held_out[row].prompt for row in rows[start : start + self._config.fit.at_once]]
            answers += self._lora_model.generate_answers(prompts, max_tokens)
        return compliant_share(self._judge, answers, [self._held_out_samples[row] for row in rows])

    @torch.no_grad()
    def _compute_held_out_loss(self) -> float:
        """Mean cross-entropy over all contract tokens of the held-out part [nats/token]."""
        total, tokens, held_out = 0.0, 0, self._data.held_out
        for start in range(0, len(held_out), self._config.fit.at_once):
            samples: Sequence[EncodedSample] = held_out[start : start + self._config.fit.at_once]
            batch = collate(samples, self._lora_model.padding_id, device=str(self._lora_model.head.device))
            hidden, labels = contract_hidden_states(self._lora_model.decoder, batch)
            log_p = log_probabilities(hidden, self._lora_model.head)
            total -= float(log_p.gather(1, labels[:, None]).sum())
            tokens += len(labels)
        return total / tokens
