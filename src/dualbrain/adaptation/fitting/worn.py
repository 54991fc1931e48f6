"""An adapter on its base in torch, without the remarks that peft makes to its developers."""

# pyright: reportMissingImports=false

from __future__ import annotations

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from peft import PeftModel


def worn(model: Any, adapter: Path) -> Any:
    """`model` with the adapter of a folder beside its layers, to be asked, not to be fitted."""
    with unremarked():
        return PeftModel.from_pretrained(model, str(adapter)).eval()


@contextmanager
def unremarked() -> Generator[None]:
    """Inside, peft does not warn of a property it reads, which transformers is about to rename."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is_gradient_checkpointing.*", FutureWarning)
        yield
