"""`dualbrain adapters export` and `dualbrain adapters diff`: an adapter for other programs, and a comparison of two."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.adapters.registry import open_adapter_registry, read_decision
from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.open_memory import print_json
from dualbrain.core.paths import cache_folder
from dualbrain.errors import ConfigurationError, UsageError

if TYPE_CHECKING:
    from dualbrain.adaptation.conversion.peft_lora import LoraPair

Flag = Annotated[bool, Parameter(negative="")]
ExportFormat = Literal["peft", "gguf", "merged", "hub"]


def export(
    name: str, out: Path, /, *, form: ExportFormat = "peft", measured: Path | None = None, robot: str = "panda"
) -> int:
    """Write an adapter for other programs, after checking that it is plain LoRA; adapters below it are included.

    The output is complete or absent, with permissions according to the umask.

    Parameters
    ----------
    name
        The beginning of an id, `champion`, the name of a packaged adapter, or a folder that training wrote.
    out
        A new folder (peft, hub), or a new file (gguf, merged).
    form
        peft: a folder that peft and vLLM load on the dequantised base. gguf: a GGUF-LoRA file for llama.cpp on the
        unchanged base. merged: base and adapter as one GGUF in float16, for programs that cannot load adapters. hub:
        as peft, with a model card for the Hugging Face Hub; nothing is uploaded.
    measured
        With the form hub: results of `dualbrain adapters measure`, which the card states, also if they are against the
        adapter. Without it the card states the comparison of the adapter's promotion, if there was one.
    robot
        The robot of `champion`.
    """
    from dualbrain.adaptation.adapters.naming import resolve_folder
    from dualbrain.adaptation.adapters.stacking import load_stack
    from dualbrain.adaptation.conversion.peft_lora import read_lora
    from dualbrain.core.storage.atomic_files import atomic_folder

    if out.exists():
        raise ConfigurationError.stating("The export path exists already.", fix=f"Name a new file or folder. {out}")
    if measured is not None and form != "hub":
        raise UsageError("--measured", got=measured, allowed="with --form hub only, for the model card")
    folder = resolve_folder(name, open_adapter_registry(), robot)
    if form == "hub":
        with atomic_folder(out) as temporary:
            _write_hub_folder(folder, measured, temporary)
    elif form == "peft" and _is_on_base_model(folder):
        read_lora(folder)
        with atomic_folder(out) as temporary:
            for file in filter(Path.is_file, folder.iterdir()):
                shutil.copyfile(file, temporary / file.name)
    else:
        from dualbrain.adaptation.conversion.concatenated_lora import concatenate_adapters, write_peft_adapter

        stack = load_stack(folder, cache_folder())
        pairs = concatenate_adapters([layer.folder for layer in stack.layers])
        if form == "peft":
            with atomic_folder(out) as temporary:
                write_peft_adapter(pairs, temporary, base=stack.layers[0].card.base_sha256)
        else:
            from dualbrain.adaptation.conversion.gguf_lora import write_gguf_lora
            from dualbrain.adaptation.conversion.merged_gguf import write_merged_gguf

            (write_gguf_lora if form == "gguf" else write_merged_gguf)(pairs, stack.gguf, out)
    StderrConsole().print(f"written: {out}", markup=False)
    return ExitCode.SUCCESS


def _write_hub_folder(folder: Path, measured: Path | None, out: Path) -> None:
    """Write the adapter in `folder`, with all adapters below it, and its model card to `out`."""
    import msgspec

    from dualbrain.adaptation.adapters.card import CONFIG_FILE, hash_weights
    from dualbrain.adaptation.adapters.model_card import hub_model_name, model_card
    from dualbrain.adaptation.adapters.registry import ADAPTER_FILES
    from dualbrain.adaptation.adapters.stacking import read_layers
    from dualbrain.adaptation.conversion.concatenated_lora import concatenate_adapters, write_peft_adapter
    from dualbrain.adaptation.conversion.peft_lora import read_lora

    layers, registry = read_layers(folder), open_adapter_registry()
    cards, base = [layer.card for layer in layers], hub_model_name(layers[0].card.base)
    if len(layers) == 1:
        read_lora(folder)
        for file in ADAPTER_FILES:
            shutil.copyfile(folder / file, out / file)
        config = msgspec.json.decode((out / CONFIG_FILE).read_bytes(), type=dict[str, object])
        config["base_model_name_or_path"] = base
        (out / CONFIG_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=2))
    else:
        write_peft_adapter(concatenate_adapters([layer.folder for layer in layers]), out, base=base)
    decision = registry.last_decision(cards[-1].id) if measured is None else read_decision(measured)
    if decision is not None and decision.candidate != cards[-1].id:
        got, needed = decision.candidate[:16] or "the bare base", cards[-1].id[:16]
        raise ConfigurationError.stating(
            f"The measurement is of {got} and not of {needed}.",
            fix="Measure this adapter: `dualbrain adapters measure`.",
        )
    history = [entry for entry in registry.entries() if entry.adapter == cards[-1].id]
    (out / "README.md").write_text(model_card(cards, hash_weights(out), decision, history), encoding="utf-8")


def _is_on_base_model(folder: Path) -> bool:
    """Whether the base of the adapter is a model and not another adapter."""
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.packaged import packaged_names

    return read_adapter_card(folder).base not in packaged_names()


def diff(first: str, second: str, /, *, robot: str = "panda", json: Flag = False) -> int:
    """Compare two adapters: the entries of their cards, and the weight change layer by layer.

    An adapter in the stack of only one of them counts as part of it.

    Parameters
    ----------
    first
        The beginning of an id, `champion`, the name of a packaged adapter, or a folder that training wrote.
    second
        Another adapter.
    robot
        The robot of `champion`.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.comparison import combine_layers, compare_cards, compare_layers
    from dualbrain.adaptation.adapters.naming import resolve_folder

    registry = open_adapter_registry()
    folders = [resolve_folder(name, registry, robot) for name in (first, second)]
    cards = [read_adapter_card(folder) for folder in folders]
    differing, found = compare_cards(cards[0], cards[1]), compare_layers(*_lora_pairs(*folders))
    if json:
        print_json({"cards": differing, "all": combine_layers(found), "layers": found})
        return ExitCode.SUCCESS
    for name, (of_first, of_second) in differing.items():
        print_result(f"{name}: {of_first} | {of_second}")
    total = combine_layers(found)
    print_result(f"‖BA‖: {total.first:.3g} | {total.second:.3g}; ‖difference‖: {total.apart:.3g}")
    for gap in found[:5]:
        print_result(f"  {gap.layer}: {gap.first:.3g} | {gap.second:.3g}; {gap.apart:.3g}")
    return ExitCode.SUCCESS


def _lora_pairs(first: Path, second: Path) -> tuple[dict[str, LoraPair], dict[str, LoraPair]]:
    """The LoRA pairs of each adapter, including the adapters below it unless both have the same base.

    Raises `ConfigurationError` if their models differ, because then the matrices differ too.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.stacking import read_layers
    from dualbrain.adaptation.conversion.concatenated_lora import concatenate_adapters

    if read_adapter_card(first).base_sha256 == read_adapter_card(second).base_sha256:
        return concatenate_adapters([first]), concatenate_adapters([second])
    first_layers, second_layers = read_layers(first), read_layers(second)
    lowest = [layers[0].card for layers in (first_layers, second_layers)]
    if lowest[0].base_sha256 != lowest[1].base_sha256:
        got = " and ".join(card.base for card in lowest)
        problem = f"Adapters of different models cannot be compared: {got}."
        raise ConfigurationError.stating(problem)
    return concatenate_adapters([layer.folder for layer in first_layers]), concatenate_adapters(
        [layer.folder for layer in second_layers]
    )
