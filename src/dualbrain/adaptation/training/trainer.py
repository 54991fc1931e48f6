"""Fitting an adapter: steps along the objective, checkpoints, and a stop when held-out answers get no better."""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from dualbrain.adaptation.compliance import Judge, share
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.adaptation.early_stopping import HeldOut, Patience
from dualbrain.adaptation.training.checkpoint import Mark, Run, load_best, load_checkpoint, save_best, save_checkpoint
from dualbrain.adaptation.training.master_weights import Masters
from dualbrain.adaptation.training.model.batching import Encoded, collate, contract_states
from dualbrain.adaptation.training.model.lora_model import Learner
from dualbrain.adaptation.training.objective import Loss, log_probabilities, objective
from dualbrain.adaptation.training.prepared_data import prepare
from dualbrain.adaptation.training.process_group import ALONE, Team
from dualbrain.adaptation.training.schedule import batches, rate
from dualbrain.errors import DualbrainError, InvalidSetup

CHECKPOINT, BEST, STATES = "checkpoint.safetensors", "best.safetensors", "base_states.safetensors"
ROOM = 1.5
"""A free answer may be this many times as long as the longest contract that was taught."""


class Diverged(DualbrainError):
    """Loss or gradient stopped being a number; the last checkpoint is from before."""

    def __init__(self, step: int, what: str) -> None:
        """Name the step, and what was no number."""
        self.step, self.what = step, what
        super().__init__(
            f"the {what} of step {step} is not finite. Nothing of this step was kept. Lower `[fit] rate`, or set "
            f'`precision = "float32"`, and name another --out: a folder keeps to its dials.'
        )


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a fit is: mean cross-entropy and divergence of the last step [nats/token], time left [s] at its pace."""

    step: int
    steps: int
    cross_entropy: float
    divergence: float
    seconds_left: float
    held_out: HeldOut | None


class Fit:
    """One fit in one folder. Run again after any interruption, it ends as if it had never been interrupted.

    Promise: the result is a function of data, dials and base alone, on one machine with one number of threads and of
    processes; it does not depend on when or how often they were killed. No step is kept whose loss was not a number.

    In a team each process computes a share of every step's samples; loss and gradients are summed, so all take the same
    step, and as many processes as there may be, it is that of one up to rounding. The first one alone asks what is held
    out, and writes.
    """

    def __init__(
        self, learner: Learner, dataset: Dataset, config: AdaptConfig, judge: Judge, folder: Path, *, base: str,
        clock: Callable[[], float], team: Team = ALONE,
    ) -> None:  # fmt: skip
        """Begin, or go on where the checkpoint in `folder` stands; `clock` [s] only tells the time left.

        `base` is the hash of what `learner` was. Raises `InvalidSetup` if a process of the team would have nothing to
        do, for what `prepare` cannot teach, and for a checkpoint of another run; then nothing in `folder` has changed.
        """
        if config.fit.batch < team.size:
            raise InvalidSetup("fit batch", got=config.fit.batch, allowed=f"a sample for each of {team.size} processes")
        self._learner, self._asked = learner, dataset.held_out
        self._config, self._judge, self._folder, self._clock = config, judge, folder, clock
        self._run = Run(dataset.card.hash, base, learner.numbers, config.objective, config.fit)
        found = load_checkpoint(folder / CHECKPOINT, self._run)
        self._taught = prepare(learner, dataset, config.objective, base, folder / STATES, team)
        self._team, self._masters = team, Masters(learner.parameters, team)
        self._plan = batches(self._taught.shown, config.fit)
        self.step, self.patience, self._best = 0, Patience(), ""
        if found:
            mark, tensors = found
            self._masters.load(tensors)
            self.step, self.patience, self._best = mark.step, mark.patience, mark.best

    @property
    def finished(self) -> bool:
        """Whether all steps are taken, or nothing got better for long enough."""
        return self.step >= self._config.fit.steps or self.patience.waited >= self._config.fit.patience

    def run(self, tell: Callable[[Progress], None] = lambda progress: None) -> HeldOut | None:
        """Take all steps that are left and wear the best adapter; returns its held-out result, None without that part.

        Raises `Diverged`, `DiskFull`, and `InvalidSetup` if the best is not any more what it was when it was examined.
        """
        dials, first, began = self._config.fit, self.step, self._clock()
        while not self.finished:
            cross_entropy, divergence = self._learn(self.step + 1)
            self.step += 1
            found = None
            last = self.step == dials.steps
            if last or self.step % dials.save_every == 0:
                found = self._examine() if last or dials.keep == "best" else None
                self._team.once(self._save)
            pace = (self._clock() - began) / (self.step - first)
            left = pace * (dials.steps - self.step)
            tell(Progress(self.step, dials.steps, cross_entropy, divergence, left, found))
        self._learner.wear(load_best(self._folder / BEST, self._best))
        return self.patience.best

    def _learn(self, step: int) -> tuple[float, float]:
        """One optimiser step; its mean cross-entropy and divergence [nats/token]."""
        dials, rows = self._config.fit, self._by_length(self._plan[step - 1])
        tokens = sum(len(self._taught.train[row].contract) for row in rows)
        mine = rows[self._team.rank :: self._team.size]
        told = torch.zeros(3, dtype=torch.float64, device=self._learner.head.device)
        for start in range(0, len(mine), dials.at_once):
            loss = self._part(mine[start : start + dials.at_once], tokens)
            loss.total.backward()
            told += torch.stack([value.detach() for value in loss])
        self._team.sum([told])
        total, cross_entropy, divergence = told.tolist()
        if not math.isfinite(total):
            raise Diverged(step, f"loss ({total})")
        norm = self._masters.step(rate(step, dials), dials.clip)
        if not math.isfinite(norm):
            raise Diverged(step, f"gradient ({norm})")
        return cross_entropy, divergence

    def _by_length(self, rows: Sequence[int]) -> list[int]:
        """`rows` with the shortest first: samples that are computed together then need little padding."""
        train = self._taught.train
        return sorted(rows, key=lambda row: len(train[row].prompt) + len(train[row].contract))

    def _part(self, rows: Sequence[int], tokens: int) -> Loss:
        """The share that some samples have in the loss of a step of `tokens` tokens."""
        dials, learner = self._config.objective, self._learner
        some = [self._taught.train[row] for row in rows]
        batch = collate(some, learner.padding, device=str(learner.head.device))
        hidden, labels = contract_states(learner.decoder, batch)
        counts = torch.tensor(batch.counts)
        weights = torch.tensor(self._taught.omega[list(rows)], dtype=torch.float32).repeat_interleave(counts)
        return objective(
            hidden, learner.head, labels, weights.to(learner.head.device), tokens, beta=dials.beta,
            base_hidden=self._taught.states.states(some) if self._taught.states else None,
            token_gate=dials.entropy_gate == "token",
        )  # fmt: skip

    def _examine(self) -> HeldOut | None:
        """Ask what is held out; keep the adapter if it is the best so far, or if there is nothing to ask."""
        found = None
        if self._taught.held_out:
            found = self._team.once(lambda: HeldOut(self.step, self._compliance(), self._held_out_loss()))
            if not math.isfinite(found.loss):
                raise Diverged(self.step, f"held-out loss ({found.loss})")
            self.patience = Patience(found) if self._config.fit.keep == "last" else self.patience.after(found)
        if found is None or self.patience.best == found:
            self._best = self._team.once(lambda: save_best(self._folder / BEST, self._learner.adapter()))
        return found

    def _save(self) -> None:
        """Write the checkpoint."""
        mark = Mark(self._run.key, self.step, self.patience, self._best, self._run.told)
        save_checkpoint(self._folder / CHECKPOINT, mark, self._masters.state())

    def _compliance(self) -> float | None:
        """The share of sound free answers to some held-out questions, evenly chosen; None if none is to be asked."""
        every = self._taught.held_out
        count = min(len(every), self._config.fit.ask_at_most)
        if not count:
            return None
        rows = [i * len(every) // count for i in range(count)]
        most = int(ROOM * max(len(one.contract) for one in self._taught.train))
        answers: list[str] = []
        for start in range(0, count, self._config.fit.at_once):
            some = [every[row].prompt for row in rows[start : start + self._config.fit.at_once]]
            answers += self._learner.answer(some, most)
        return share(self._judge, answers, [self._asked[row] for row in rows])

    @torch.no_grad()
    def _held_out_loss(self) -> float:
        """Mean cross-entropy over the contract tokens of all that is held out [nats/token]."""
        total, tokens, every = 0.0, 0, self._taught.held_out
        for start in range(0, len(every), self._config.fit.at_once):
            some: Sequence[Encoded] = every[start : start + self._config.fit.at_once]
            batch = collate(some, self._learner.padding, device=str(self._learner.head.device))
            hidden, labels = contract_states(self._learner.decoder, batch)
            log_p = log_probabilities(hidden, self._learner.head)
            total -= float(log_p.gather(1, labels[:, None]).sum())
            tokens += len(labels)
        return total / tokens
