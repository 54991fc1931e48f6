"""dualbrain adapters export and diff: an adapter for other programs, and what tells two of them apart."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.adapters.registry import registry_of_adapters
from dualbrain.cli.common.console import Account, answer
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache
from dualbrain.cli.memory.open_memory import tell
from dualbrain.errors import InvalidSetup

if TYPE_CHECKING:
    from dualbrain.adaptation.conversion.peft_lora import Pair

Flag = Annotated[bool, Parameter(negative="")]
Form = Literal["peft", "gguf", "merged"]


def export(name: str, out: Path, /, *, form: Form = "peft", robot: str = "panda") -> int:
    """Write an adapter, verified, for other programs; what it sits on besides the model is put into it.

    It is there whole or not at all, and may be read by whom the umask lets.

    Parameters
    ----------
    name
        The beginning of its id, `champion`, the name of one that comes with dualbrain, or a folder that a fit left.
    out
        A new folder (peft), or a new file (gguf, merged).
    form
        peft: a folder that peft and vLLM load on the dequantised base. gguf: a GGUF-LoRA file for llama.cpp on the
        untouched base. merged: base and adapter as one GGUF in float16, for programs that load no adapters.
    robot
        Whose champion.
    """
    from dualbrain.adaptation.adapters.naming import folder_of
    from dualbrain.adaptation.adapters.stacking import stack_of
    from dualbrain.core.storage.atomic_files import whole_folder

    if out.exists():
        raise InvalidSetup("place to export to", got=str(out), allowed="a name that is free")
    folder = folder_of(name, registry_of_adapters(), robot)
    if form == "peft" and _alone(folder):
        with whole_folder(out) as beside:
            for file in filter(Path.is_file, folder.iterdir()):
                shutil.copyfile(file, beside / file.name)
    else:
        from dualbrain.adaptation.conversion.concatenated_lora import combined, write_peft

        stack = stack_of(folder, cache())
        pairs = combined([layer.folder for layer in stack.layers])
        if form == "peft":
            with whole_folder(out) as beside:
                write_peft(pairs, beside, base=stack.layers[0].card.base_sha256)
        else:
            from dualbrain.adaptation.conversion.gguf_lora import write_gguf_lora
            from dualbrain.adaptation.conversion.merged_gguf import write_merged

            (write_gguf_lora if form == "gguf" else write_merged)(pairs, stack.gguf, out)
    Account().print(f"written: {out}")
    return Exit.SUCCESS


def _alone(folder: Path) -> bool:
    """Whether the adapter sits on a model and not on another adapter."""
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.packaged import packaged_names

    return read_adapter_card(folder).base not in packaged_names()


def diff(first: str, second: str, /, *, robot: str = "panda", json: Flag = False) -> int:
    """Tell two adapters apart: how they were made, and how far what they compute differs, layer by layer.

    What only one of them sits on besides the model counts as its own.

    Parameters
    ----------
    first
        The beginning of an id, `champion`, the name of one that comes with dualbrain, or a folder that a fit left.
    second
        Another.
    robot
        Whose champion.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.comparison import gaps, overall, told_apart
    from dualbrain.adaptation.adapters.naming import folder_of

    registry = registry_of_adapters()
    folders = [folder_of(name, registry, robot) for name in (first, second)]
    cards = [read_adapter_card(folder) for folder in folders]
    apart, found = told_apart(cards[0], cards[1]), gaps(*_computed(*folders))
    if json:
        tell({"cards": apart, "all": overall(found), "layers": found})
        return Exit.SUCCESS
    for name, (ours, theirs) in apart.items():
        answer(f"{name}: {ours} | {theirs}")
    whole = overall(found)
    answer(f"‖BA‖: {whole.first:.3g} | {whole.second:.3g}; ‖difference‖: {whole.apart:.3g}")
    for gap in found[:5]:
        answer(f"  {gap.layer}: {gap.first:.3g} | {gap.second:.3g}; {gap.apart:.3g}")
    return Exit.SUCCESS


def _computed(first: Path, second: Path) -> tuple[dict[str, Pair], dict[str, Pair]]:
    """The pairs of each adapter, with those of what it sits on unless both sit on the same.

    Raises `InvalidSetup` if their models differ: then so do the matrices that are changed.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.stacking import layers_of
    from dualbrain.adaptation.conversion.concatenated_lora import combined

    if read_adapter_card(first).base_sha256 == read_adapter_card(second).base_sha256:
        return combined([first]), combined([second])
    ours, theirs = layers_of(first), layers_of(second)
    lowest = [layers[0].card for layers in (ours, theirs)]
    if lowest[0].base_sha256 != lowest[1].base_sha256:
        got = " and ".join(card.base for card in lowest)
        raise InvalidSetup("models below two adapters to compare", got=got, allowed="one and the same")
    return combined([layer.folder for layer in ours]), combined([layer.folder for layer in theirs])
