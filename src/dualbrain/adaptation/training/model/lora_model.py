"""The planner during training: a frozen base with low-rank adapters on its linear layers (Hu et al. 2022)."""

# pyright: reportMissingImports=false

from __future__ import annotations

import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from peft import LoraConfig, PeftModel, get_peft_model, get_peft_model_state_dict, set_peft_model_state_dict
from torch import Tensor

from dualbrain.adaptation.config import FitConfig
from dualbrain.adaptation.conversion.peft_lora import require_plain_lora
from dualbrain.adaptation.training.model.batching import EncodedSample, collate, contract_hidden_states
from dualbrain.errors import ConfigurationError

LOGIT_TOLERANCE = {torch.float32: 1e-3, torch.bfloat16: 2.0**-7}
"""Tolerance of logits computed from hidden states, relative to the largest logit: only rounding is tolerated."""


class LoraModel:
    """Base and adapter. Output matrix, embeddings and norms stay frozen, so p_θ0 can be computed exactly.

    `decoder` gives hidden states, `head` (V, d) is the output matrix, `parameters` are those of the adapter by name,
    `max_tokens` is the length of the context.
    """

    def __init__(self, model: Any, tokenizer: Any, config: FitConfig) -> None:
        """Add a new adapter to `model`, the same for the same seed; before the first step it has no effect.

        Raises `ConfigurationError` if peft would make an adapter other than plain LoRA.
        """
        torch.manual_seed(config.seed)
        self.tokenizer, self.base_model = tokenizer, model
        shape = LoraConfig(
            r=config.rank, lora_alpha=config.alpha, lora_dropout=0.0, target_modules="all-linear", task_type="CAUSAL_LM"
        )
        require_plain_lora(shape.to_dict())  # an adapter that cannot be served is not trained
        with suppress_peft_warning():
            self.model = get_peft_model(model, shape, autocast_adapter_dtype=False)
        self.model.eval()  # without dropout, evaluation and training compute the same
        self.decoder, self.head = model.get_decoder(), model.get_output_embeddings().weight.detach()
        self.parameters = {name: p for name, p in self.model.named_parameters() if p.requires_grad}
        self.number_format = str(self.head.dtype) + (
            "" if config.quantise == "none" else f", layers in {config.quantise}"
        )
        padding = tokenizer.pad_token_id
        self.padding_id = tokenizer.eos_token_id if padding is None else padding
        self.max_tokens = int(model.config.max_position_embeddings)

    @contextmanager
    def without_adapter(self) -> Generator[None]:
        """In this context, the adapter is disabled."""
        with self.model.disable_adapter():
            yield

    def adapter_tensors(self) -> dict[str, Tensor]:
        """The adapter's tensors under the names that peft reads."""
        return {name: t.detach().contiguous() for name, t in get_peft_model_state_dict(self.model).items()}

    def load_adapter(self, adapter: dict[str, Tensor]) -> None:
        """Replace the weights of the present adapter by `adapter`."""
        set_peft_model_state_dict(self.model, adapter)

    @torch.no_grad()
    def check_logits(self, sample: EncodedSample) -> None:
        """Raise `ConfigurationError` unless the model's logits are hidden·headᵀ, without scaling or capping."""
        batch = collate([sample], self.padding_id, device=str(self.head.device))
        hidden, _ = contract_hidden_states(self.decoder, batch)
        all_logits = self.base_model(input_ids=batch.ids, use_cache=False).logits
        n_tokens = len(sample.contract)
        model_logits = all_logits[0, len(sample.prompt) - 1 :][:n_tokens].float()
        computed_logits = hidden.float() @ self.head.float().T
        if (gap := float((computed_logits - model_logits).abs().max())) > LOGIT_TOLERANCE[self.head.dtype] * (
            1.0 + float(model_logits.abs().max())
        ):
            problem = f"The logits of the base differ by {gap:.3g} from hidden·headᵀ."
            raise ConfigurationError.stating(problem, fix="Choose a base whose output layer is one plain matrix.")

    @torch.no_grad()
    def generate_answers(self, prompts: Sequence[Sequence[int]], max_tokens: int) -> list[str]:
        """Unconstrained greedy answers of at most `max_tokens` tokens; an answer that does not end is cut."""
        longest = max(len(prompt) for prompt in prompts)
        ids = torch.full((len(prompts), longest), self.padding_id)
        mask = torch.zeros_like(ids)
        for row, prompt in enumerate(prompts):  # padded on the left: all answers start at the same position
            ids[row, longest - len(prompt) :] = torch.tensor(prompt)
            mask[row, longest - len(prompt) :] = 1
        device, end = self.head.device, self.tokenizer.eos_token_id
        output = self.model.generate(
            input_ids=ids.to(device),
            attention_mask=mask.to(device),
            max_new_tokens=max_tokens,
            do_sample=False,
            temperature=None,
            top_p=None,
            top_k=None,
            pad_token_id=self.padding_id,
            eos_token_id=end,
        )
        return self.tokenizer.batch_decode(output[:, longest:], skip_special_tokens=True)


def load_peft_adapter(model: Any, adapter: Path) -> Any:
    """`model` with the adapter in a folder, for inference."""
    with suppress_peft_warning():
        return PeftModel.from_pretrained(model, str(adapter)).eval()


@contextmanager
def suppress_peft_warning() -> Generator[None]:
    """In this context, peft does not warn about a property that transformers is going to rename."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is_gradient_checkpointing.*", FutureWarning)
        yield
