"""AdamW on float32 master weights, so that an adapter in bf16 can be trained with small steps."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dualbrain.adaptation.training.process_group import SINGLE_PROCESS, ProcessGroup

ADAM_STATE_NAMES = ("step", "exp_avg", "exp_avg_sq")


class MasterWeights:
    """Float32 master weights of all parameters; each parameter is its master weight, rounded.

    A bf16 number has 8 significant bits, so a step of 1e-3 of its size would be lost. Adapters in bf16 avoid the format
    conversions that adapters in float32 need at every layer.

    In a process group each process has its own copy, equal to the bit: gradients are summed over the processes in
    float32, and all take the same step.
    """

    def __init__(
        self, parameters: Mapping[str, torch.nn.Parameter], process_group: ProcessGroup = SINGLE_PROCESS
    ) -> None:
        """Copy `parameters`, by name."""
        self._parameters, self._process_group = dict(parameters), process_group
        self._weights = {name: p.detach().float().clone() for name, p in parameters.items()}
        self._adam = torch.optim.AdamW(list(self._weights.values()), weight_decay=0.0)

    def step(self, rate: float, clip: float) -> float:
        """One optimiser step; gradients are clipped to the norm `clip`. Returns their norm before and clears them.

        If the norm is not finite, nothing is changed.
        """
        for name, parameter in self._parameters.items():
            self._weights[name].grad = None if parameter.grad is None else parameter.grad.float()
            parameter.grad = None
        self._process_group.all_reduce_sum([master.grad for master in self._weights.values()])
        norm = torch.nn.utils.clip_grad_norm_(list(self._weights.values()), clip)
        if not torch.isfinite(norm):
            return float(norm)
        for group in self._adam.param_groups:
            group["lr"] = rate
        self._adam.step()
        self._copy_to_parameters()
        return float(norm)

    def state_dict(self) -> dict[str, Tensor]:
        """Master weights and moments by name."""
        state = {f"master/{name}": master for name, master in self._weights.items()}
        for name, master in self._weights.items():
            state |= {
                f"{what}/{name}": self._adam.state[master][what]
                for what in ADAM_STATE_NAMES
                if self._adam.state[master]
            }
        return state

    def load_state_dict(self, stored: Mapping[str, Tensor]) -> None:
        """Resume exactly from `stored`, as returned by `state_dict`."""
        for name, master in self._weights.items():
            master.copy_(stored[f"master/{name}"])
            moments = {what: stored[f"{what}/{name}"].to(master.device, copy=True) for what in ADAM_STATE_NAMES}
            self._adam.state[master] = moments | {"step": moments["step"].cpu()}  # torch counts on the processor
        self._copy_to_parameters()

    @torch.no_grad()
    def _copy_to_parameters(self) -> None:
        for name, parameter in self._parameters.items():
            parameter.copy_(self._weights[name])
