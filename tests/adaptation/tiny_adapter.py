"""A tiny base in a cache and in the manifest, and adapters for it with cards, as training leaves them."""

import hashlib

from dualbrain.adaptation.adapters.card import AdapterCard, hash_weights, write_adapter_card
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.core import weights
from dualbrain.core.weights import WeightFile
from dualbrain.planner.prompt.short_prompt import short_template_hash
from tests.adaptation.tiny_gguf import model, random_adapter, write_gguf
from tests.planner.sample_requests import REGISTRY

BASE = "tiny"


def install_base(cache, patch):
    """Write the base's file to `cache` and its entry to the manifest; returns the torch model."""
    cache.mkdir(exist_ok=True)
    made = model("llama")
    path = write_gguf(made, "llama", cache / "tiny.gguf")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    patch.setitem(
        weights.MANIFEST,
        BASE,
        WeightFile(name=BASE, filename="tiny.gguf", licence="-", sha256=digest, size=path.stat().st_size, parts=()),
    )
    return made


def write_adapter(made, folder, seed=5, size=0.1, **changed):
    """Write an adapter on the torch model `made` to `folder`; returns the model with the adapter, and its card."""
    adapted = random_adapter(made, folder, seed=seed, size=size)
    facts = {
        "id": hash_weights(folder),
        "base": BASE,
        "base_sha256": weights.find_weight_file(BASE).sha256,
        "robot": REGISTRY.robot,
        "registry": REGISTRY.hash,
        "prompt": short_template_hash(),
        "dataset": "d" * 64,
        "sources": {BASE: 3},
        "bootstrapped": False,
        "precision": "float32",
        "steps": 7,
        "held_out": None,
        "config": AdaptConfig(),
        "versions": {},
    }
    card = AdapterCard(**(facts | changed))
    write_adapter_card(card, folder)
    return adapted, card
