"""A model small enough for a test: two layers, 32 numbers wide, random weights, bytes as tokens, no download."""

import torch
from tokenizers import Tokenizer, decoders, models, pre_tokenizers
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

from dualbrain.adaptation.config import FitConfig
from dualbrain.adaptation.training.model.batching import EncodedSample
from dualbrain.adaptation.training.model.lora_model import LoraModel

torch.set_num_threads(1)
TEMPLATE = "{% for m in messages %}{{ m['role'][0] + ':' + m['content'] }}{% endfor %}A:"
TRAINING_CONFIG = FitConfig(
    steps=6, batch=4, at_once=4, rank=4, alpha=8, save_every=2, warm_up=2, rate=1e-2, ask_at_most=2
)


def tokenizer():
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {letter: number for number, letter in enumerate([*letters, "<end>", "<pad>"])}
    inner = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    inner.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    inner.decoder = decoders.ByteLevel()
    made = PreTrainedTokenizerFast(tokenizer_object=inner, eos_token="<end>", pad_token="<pad>")
    made.chat_template = TEMPLATE
    return made


def model(seed=0, layers=2, width=32, inner=48):
    torch.manual_seed(seed)
    shape = LlamaConfig(
        vocab_size=258,
        hidden_size=width,
        intermediate_size=inner,
        num_hidden_layers=layers,
        num_attention_heads=4,
        num_key_value_heads=2,
        max_position_embeddings=2048,
        tie_word_embeddings=True,
        pad_token_id=257,
        eos_token_id=256,
        bos_token_id=256,
        initializer_range=0.2,
    )
    made = LlamaForCausalLM(shape).eval().requires_grad_(False)
    made.config._attn_implementation = "eager"
    return made


def lora_model(config=TRAINING_CONFIG):
    return LoraModel(model(), tokenizer(), config)


def perturbed(one, size=0.2, seed=3):
    """Change the adapter of `one` at random, so that it has an effect."""
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in one.parameters.values():
            parameter.add_(size * torch.randn_like(parameter))
    return one


def random_samples(n, seed=1, longest=12):
    """Prompts and contracts of random tokens, of unequal length."""
    made = torch.Generator().manual_seed(seed)

    def random_tokens(least):
        length = int(torch.randint(least, longest, (1,), generator=made))
        return tuple(torch.randint(0, 250, (length,), generator=made).tolist())

    return [EncodedSample(f"s{i}", random_tokens(3), (*random_tokens(2), 256)) for i in range(n)]
