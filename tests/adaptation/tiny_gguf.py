"""A tiny random model in torch and, with the same weights, as GGUF, so that both computations can be compared."""

import sys

import gguf
import numpy as np
import torch
from peft import LoraConfig, get_peft_model
from safetensors.torch import load_file, save_file
from transformers import LlamaConfig, LlamaForCausalLM, Qwen2Config, Qwen2ForCausalLM

from dualbrain.adaptation.conversion.peft_lora import WEIGHTS_FILE
from tests.adaptation.tiny_model import TEMPLATE, tokenizer

KINDS = {"llama": (LlamaConfig, LlamaForCausalLM), "qwen2": (Qwen2Config, Qwen2ForCausalLM)}
HEADS, KV_HEADS, LAYERS, WIDTH = 4, 2, 2, 64


def model(architecture, seed=0):
    torch.manual_seed(seed)
    config, kind = KINDS[architecture]
    shape = config(
        vocab_size=258,
        hidden_size=WIDTH,
        intermediate_size=96,
        num_hidden_layers=LAYERS,
        num_attention_heads=HEADS,
        num_key_value_heads=KV_HEADS,
        max_position_embeddings=2048,
        tie_word_embeddings=True,
        pad_token_id=257,
        eos_token_id=256,
        bos_token_id=256,
        initializer_range=0.2,
        rms_norm_eps=1e-5,
    )
    made = kind(shape).eval().requires_grad_(False)
    made.config._attn_implementation = "eager"
    for name, tensor in made.state_dict().items():
        if name.endswith("bias"):
            tensor.copy_(0.1 * torch.randn_like(tensor))
    return made


def interleave_rows(rows, heads):
    """Rows of q or k in the order of llama.cpp for `llama`, index by index, independent of the converter."""
    half = len(rows) // heads // 2
    order = [h * 2 * half + i + part * half for h in range(heads) for i in range(half) for part in (0, 1)]
    return rows[order]


def write_gguf(made, architecture, path):
    """The model `made` as a GGUF file in float32."""
    shape = made.config
    writer = gguf.GGUFWriter(path, architecture)
    writer.add_context_length(2048)
    writer.add_embedding_length(WIDTH)
    writer.add_block_count(LAYERS)
    writer.add_feed_forward_length(shape.intermediate_size)
    writer.add_head_count(HEADS)
    writer.add_head_count_kv(KV_HEADS)
    writer.add_rope_dimension_count(WIDTH // HEADS)
    writer.add_rope_freq_base(float(getattr(shape, "rope_theta", None) or shape.rope_parameters["rope_theta"]))
    writer.add_layer_norm_rms_eps(shape.rms_norm_eps)
    writer.add_vocab_size(258)
    _add_tokenizer(writer)
    kind = {name: arch for arch, name in gguf.MODEL_ARCH_NAMES.items()}[architecture]
    names = gguf.get_tensor_name_map(kind, LAYERS)
    for name, tensor in made.state_dict().items():
        if name == "lm_head.weight":
            continue
        base, _, part = name.rpartition(".")
        rows = tensor.detach().float().numpy()
        if architecture == "llama" and base.endswith(("q_proj", "k_proj")):
            rows = interleave_rows(rows, HEADS if base.endswith("q_proj") else KV_HEADS)
        writer.add_tensor(f"{names.get_name(base)}.{part}", np.ascontiguousarray(rows))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return path


def _add_tokenizer(writer):
    vocabulary = tokenizer().get_vocab()
    tokens = sorted(vocabulary, key=vocabulary.get)
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre("smollm")
    writer.add_token_list(tokens)
    writer.add_token_types([gguf.TokenType.NORMAL] * 256 + [gguf.TokenType.CONTROL] * 2)
    writer.add_token_merges(["Ā ā"])
    writer.add_bos_token_id(256)
    writer.add_eos_token_id(256)
    writer.add_pad_token_id(257)
    writer.add_add_bos_token(value=False)
    writer.add_chat_template(TEMPLATE)


class TokenizerWithMerge:
    """The tiny vocabulary, with the result of the file's only merge as its last token, as transformers requires."""

    def __init__(self, tokenizer):
        self._tokenizer = tokenizer

    def get_vocab(self):
        vocabulary = self._tokenizer.get_vocab()
        last = next(token for token, number in vocabulary.items() if number == 255)
        return {("Āā" if token == last else token): number for token, number in vocabulary.items()}


def patch_tokenizer(patch):
    """From now on, GGUF files are written that transformers can read too."""
    original = tokenizer
    patch.setattr(sys.modules[__name__], "tokenizer", lambda: TokenizerWithMerge(original()))


def random_adapter(made, folder, dtype=torch.float32, seed=5, size=0.1, **changed):
    """A random adapter on `made`, written as by peft; returns the model with the adapter."""
    config = LoraConfig(
        **({"r": 4, "lora_alpha": 12, "target_modules": "all-linear", "task_type": "CAUSAL_LM"} | changed)
    )
    adapted = get_peft_model(made, config, autocast_adapter_dtype=False).eval()
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in adapted.parameters():
            if parameter.requires_grad:
                parameter.copy_((size * torch.randn_like(parameter)).to(dtype).float())
    adapted.save_pretrained(folder)
    tensors = load_file(folder / WEIGHTS_FILE)
    save_file({name: tensor.to(dtype).contiguous() for name, tensor in tensors.items()}, folder / WEIGHTS_FILE)
    return adapted
