"""dualbrain adapters export and diff: an adapter for other programs, and what tells two of them apart."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.adapters.registry import open_adapter_registry
from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder
from dualbrain.cli.memory.open_memory import print_json
from dualbrain.errors import ConfigurationError

if TYPE_CHECKING:
    from dualbrain.adaptation.conversion.peft_lora import LoraPair

Flag = Annotated[bool, Parameter(negative="")]
ExportFormat = Literal["peft", "gguf", "merged"]


def export(name: str, out: Path, /, *, form: ExportFormat = "peft", robot: str = "panda") -> int:
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
    from dualbrain.adaptation.adapters.naming import resolve_folder
    from dualbrain.adaptation.adapters.stacking import load_stack
    from dualbrain.core.storage.atomic_files import atomic_folder

    if out.exists():
        raise ConfigurationError("place to export to", got=str(out), allowed="a name that is free")
    folder = resolve_folder(name, open_adapter_registry(), robot)
    if form == "peft" and _is_on_base_model(folder):
        with atomic_folder(out) as beside:
            for file in filter(Path.is_file, folder.iterdir()):
                shutil.copyfile(file, beside / file.name)
    else:
        from dualbrain.adaptation.conversion.concatenated_lora import concatenate_adapters, write_peft_adapter

        stack = load_stack(folder, cache_folder())
        pairs = concatenate_adapters([layer.folder for layer in stack.layers])
        if form == "peft":
            with atomic_folder(out) as beside:
                write_peft_adapter(pairs, beside, base=stack.layers[0].card.base_sha256)
        else:
            from dualbrain.adaptation.conversion.gguf_lora import write_gguf_lora
            from dualbrain.adaptation.conversion.merged_gguf import write_merged_gguf

            (write_gguf_lora if form == "gguf" else write_merged_gguf)(pairs, stack.gguf, out)
    StderrConsole().print(f"written: {out}")
    return ExitCode.SUCCESS


def _is_on_base_model(folder: Path) -> bool:
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
    from dualbrain.adaptation.adapters.comparison import combine_layers, compare_cards, compare_layers
    from dualbrain.adaptation.adapters.naming import resolve_folder

    registry = open_adapter_registry()
    folders = [resolve_folder(name, registry, robot) for name in (first, second)]
    cards = [read_adapter_card(folder) for folder in folders]
    apart, found = compare_cards(cards[0], cards[1]), compare_layers(*_lora_pairs(*folders))
    if json:
        print_json({"cards": apart, "all": combine_layers(found), "layers": found})
        return ExitCode.SUCCESS
    for name, (ours, theirs) in apart.items():
        print_result(f"{name}: {ours} | {theirs}")
    whole = combine_layers(found)
    print_result(f"‖BA‖: {whole.first:.3g} | {whole.second:.3g}; ‖difference‖: {whole.apart:.3g}")
    for gap in found[:5]:
        print_result(f"  {gap.layer}: {gap.first:.3g} | {gap.second:.3g}; {gap.apart:.3g}")
    return ExitCode.SUCCESS


def _lora_pairs(first: Path, second: Path) -> tuple[dict[str, LoraPair], dict[str, LoraPair]]:
    """The pairs of each adapter, with those of what it sits on unless both sit on the same.

    Raises `InvalidSetup` if their models differ: then so do the matrices that are changed.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.stacking import read_layers
    from dualbrain.adaptation.conversion.concatenated_lora import concatenate_adapters

    if read_adapter_card(first).base_sha256 == read_adapter_card(second).base_sha256:
        return concatenate_adapters([first]), concatenate_adapters([second])
    ours, theirs = read_layers(first), read_layers(second)
    lowest = [layers[0].card for layers in (ours, theirs)]
    if lowest[0].base_sha256 != lowest[1].base_sha256:
        got = " and ".join(card.base for card in lowest)
        raise ConfigurationError("models below two adapters to compare", got=got, allowed="one and the same")
    return concatenate_adapters([layer.folder for layer in ours]), concatenate_adapters(
        [layer.folder for layer in theirs]
    )
