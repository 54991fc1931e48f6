"""The planner under adaptation: a frozen base with low-rank adapters beside its linear layers (Hu et al. 2022)."""

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
"""How far logits made from hidden states may be from the model's own, as a part of the largest: rounding only."""


class LoraModel:
    """Base and adapter. Output matrix, embeddings and norms stay as they are, so p_θ0 stays at hand, exactly."""

    def __init__(self, model: Any, tokenizer: Any, config: FitConfig) -> None:
        """Put a fresh adapter on `model`, the same for the same seed; it changes nothing before the first step."""
        torch.manual_seed(config.seed)
        self.tokenizer, self.base_model = tokenizer, model
        shape = LoraConfig(
            r=config.rank, lora_alpha=config.alpha, lora_dropout=0.0, target_modules="all-linear", task_type="CAUSAL_LM"
        )
        require_plain_lora(shape.to_dict())  # what could not be served is not worth a night
        with suppress_peft_warning():
            self.model = get_peft_model(model, shape, autocast_adapter_dtype=False)
        self.model.eval()  # there is no dropout; what evaluation and training compute must be the same
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
        """The model without its adapter."""
        with self.model.disable_adapter():
            yield

    def adapter_tensors(self) -> dict[str, Tensor]:
        """The adapter's tensors under the names that peft reads."""
        return {name: t.detach().contiguous() for name, t in get_peft_model_state_dict(self.model).items()}

    def load_adapter(self, adapter: dict[str, Tensor]) -> None:
        """Take on `adapter` in place of the present one."""
        set_peft_model_state_dict(self.model, adapter)

    @torch.no_grad()
    def check_logits(self, sample: EncodedSample) -> None:
        """Raise `InvalidSetup` if the model makes its logits otherwise than as hidden·headᵀ (scaled, capped)."""
        batch = collate([sample], self.padding_id, device=str(self.head.device))
        hidden, _ = contract_hidden_states(self.decoder, batch)
        own = self.base_model(input_ids=batch.ids, use_cache=False).logits
        last = len(sample.contract)
        theirs = own[0, len(sample.prompt) - 1 :][:last].float()
        ours = hidden.float() @ self.head.float().T
        if (gap := float((ours - theirs).abs().max())) > LOGIT_TOLERANCE[self.head.dtype] * (
            1.0 + float(theirs.abs().max())
        ):
            fix = "Choose a base whose last layer is one plain matrix."
            raise ConfigurationError(
                "logits of the base", got=f"{gap:.3g} away from hidden·headᵀ", allowed="equal", fix=fix
            )

    @torch.no_grad()
    def generate_answers(self, prompts: Sequence[Sequence[int]], max_tokens: int) -> list[str]:
        """Free greedy answers, at most `most` tokens long; one that does not end is returned as far as it came."""
        longest = max(len(prompt) for prompt in prompts)
        ids = torch.full((len(prompts), longest), self.padding_id)
        mask = torch.zeros_like(ids)
        for row, prompt in enumerate(prompts):  # padded on the left: all go on at the same place
            ids[row, longest - len(prompt) :] = torch.tensor(prompt)
            mask[row, longest - len(prompt) :] = 1
        device, end = self.head.device, self.tokenizer.eos_token_id
        told = self.model.generate(
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
        return self.tokenizer.batch_decode(told[:, longest:], skip_special_tokens=True)


def load_peft_adapter(model: Any, adapter: Path) -> Any:
    """`model` with the adapter of a folder beside its layers, to be asked, not to be fitted."""
    with suppress_peft_warning():
        return PeftModel.from_pretrained(model, str(adapter)).eval()


@contextmanager
def suppress_peft_warning() -> Generator[None]:
    """Inside, peft does not warn of a property it reads, which transformers is about to rename."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is_gradient_checkpointing.*", FutureWarning)
        yield
