"""Opening a planner by name: models and servers of `dualbrain.planner`, and adapters."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from dualbrain.adaptation.adapters.card import CONFIG_FILE, TORCH_SUFFIX, AdapterCard, hash_metadata_files
from dualbrain.adaptation.adapters.compatibility import require_compatible, require_same_prompt
from dualbrain.adaptation.adapters.naming import (
    ADAPTER_PREFIX,
    CHAMPION,
    SHADOW_PREFIX,
    TORCH_PREFIX,
    is_adapter,
    parse_shadow_name,
    resolve_folder,
    strip_torch_prefix,
)
from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.adapters.registry import AdapterRegistry
from dualbrain.adaptation.adapters.stacking import AdapterStack, adapter_author, load_stack
from dualbrain.adaptation.serving.adapted_planner import AdaptedPlanner
from dualbrain.adaptation.serving.canary import CANARY_QUESTIONS, CanaryCheck
from dualbrain.adaptation.serving.gguf_cache import base_path, prepare_adapters, prepare_base
from dualbrain.adaptation.serving.raw_completion import runtime_name
from dualbrain.adaptation.serving.shadow import ShadowedPlanner
from dualbrain.core.weights import locate_weights
from dualbrain.errors import MissingDependencyError, UnknownNameError
from dualbrain.planner import registry as plain
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.introspection import planner_template
from dualbrain.planner.prompt.prompt_format import (
    FULL_PROMPT,
    LOCAL_FULL_PROMPT,
    SHORT_PROMPT,
    PromptFormat,
    short_prompt,
    without_constraints,
)
from dualbrain.planner.protocol import Planner

N_CTX = 4096
"""Tokens of context: the longest short prompt with exemplars plus the longest answer."""
NAME_FORMS = (f"{ADAPTER_PREFIX}ID", f"{ADAPTER_PREFIX}{CHAMPION}", f"{SHADOW_PREFIX}ID@PLANNER", f"{TORCH_PREFIX}NAME")
"""Forms of names that a list of known names shows in addition."""
CANARY_FOLDER, SHADOW_FOLDER = "canaries", "shadows"


def open_planner(
    name: str,
    cache: Path,
    *,
    adapters: Path,
    robot: str = "",
    registry: str = "",
    key: str = "",
    dialect: str = "openai",
    threads: int = 1,
    timeout_s: float = 600.0,
    prompt_cache: Path | None = None,
    narrowed_registries: Mapping[str, str] = {},
) -> Planner:
    """The planner called `name`, ready to propose.

    `adapter:ID`, `adapter:champion` or the name of a packaged adapter; `shadow:ID@PLANNER` for a candidate that is
    asked too and whose answers are only logged; `transformers:NAME` for a model or an adapter in torch; all other names
    as in `planner.registry.open_planner`. `adapters` is the folder of the registry. With `robot` (and the hash
    `registry` of its vocabulary) an adapter that was not trained for them is rejected before a process starts;
    `narrowed_registries` maps narrower vocabularies to wider ones (see `require_compatible`). `timeout_s` [s] limits
    one proposal.

    Raises `ConfigurationError`, `UnknownNameError`, `MissingDependencyError`, `ChecksumError`, `AdapterMismatchError`.
    """
    config = LlamaConfig(threads=threads, n_ctx=N_CTX, timeout_s=timeout_s)
    if name.startswith(SHADOW_PREFIX):
        candidate, serving = parse_shadow_name(name)
        with ExitStack() as on_failure:
            shadow = open_adapter(
                candidate,
                cache,
                adapters=adapters,
                robot=robot,
                registry=registry,
                config=config,
                narrowed_registries=narrowed_registries,
            )
            on_failure.callback(shadow.close)
            served = open_planner(
                serving,
                cache,
                adapters=adapters,
                robot=robot,
                registry=registry,
                key=key,
                dialect=dialect,
                threads=threads,
                timeout_s=timeout_s,
                prompt_cache=prompt_cache,
                narrowed_registries=narrowed_registries,
            )
            on_failure.callback(served.close)
            both = ShadowedPlanner(served, shadow, shadow_log_path(adapters, shadow.card.id))
            on_failure.pop_all()
            return both
    if name.startswith(TORCH_PREFIX):
        within = (threads, timeout_s)
        return _open_in_torch(
            strip_torch_prefix(name),
            cache,
            adapters,
            robot=robot,
            registry=registry,
            limits=within,
            narrowed_registries=narrowed_registries,
        )
    if is_adapter(name):
        return open_adapter(
            name,
            cache,
            adapters=adapters,
            robot=robot,
            registry=registry,
            config=config,
            narrowed_registries=narrowed_registries,
        )
    try:
        return plain.open_planner(
            name, cache, key=key, dialect=dialect, threads=threads, timeout_s=timeout_s, prompt_cache=prompt_cache
        )
    except UnknownNameError as error:
        if error.kind != plain.UNKNOWN_NAME_KIND:  # a part of an address, with its own list of known names
            raise
        known = (*plain.planner_names(), *packaged_names(), *NAME_FORMS)
        raise UnknownNameError(
            plain.UNKNOWN_NAME_KIND, error.name, known, owner=f"this installation ({plain.OTHER_FORMS_HINT})"
        ) from error


def can_be_unconstrained(name: str) -> bool:
    """Whether `open_unconstrained` can open `name`: local models, with or without an adapter."""
    return is_adapter(core := strip_torch_prefix(name)) or core in plain.planner_names()


def open_unconstrained(name: str, cache: Path, *, adapters: Path, robot: str = "", registry: str = "") -> Planner:
    """The planner called `name` with unconstrained decoding, so that an answer shows only the model's own knowledge.

    For measurements; a gate checks the answers of any planner before a robot acts. `can_be_unconstrained` lists the
    accepted names.
    """
    if name.startswith(TORCH_PREFIX):
        return _open_in_torch(
            strip_torch_prefix(name), cache, adapters, robot=robot, registry=registry, unconstrained=True
        )
    if is_adapter(name):
        return open_adapter(
            name,
            cache,
            adapters=adapters,
            robot=robot,
            registry=registry,
            unconstrained=True,
        )
    return LlamaPlanner(name, locate_weights(name, cache), prompt_format=without_constraints(FULL_PROMPT))


def open_adapter(
    name: str,
    cache: Path,
    *,
    adapters: Path,
    robot: str = "",
    registry: str = "",
    config: LlamaConfig | None = None,
    unconstrained: bool = False,
    narrowed_registries: Mapping[str, str] = {},
) -> AdaptedPlanner:
    """The adapter called `name` as a planner; its first canary has been checked when this returns."""
    stack = load_stack(resolve_folder(name, AdapterRegistry(adapters), robot), cache)
    card = stack.top_card
    require_same_prompt(card)
    if robot:
        require_compatible(card, robot, registry, narrowed_registries)
    chosen = config or LlamaConfig(n_ctx=N_CTX)
    short = short_prompt(scene_values=card.scene_values)
    prompt_format = without_constraints(short) if unconstrained else short
    with ExitStack() as on_failure:
        planner = start_llama(stack, cache, chosen, name=proposal_author(name, stack), prompt_format=prompt_format)
        on_failure.callback(planner.close)
        adapted = AdaptedPlanner(
            planner, card, make_canary_check(planner, stack, cache, adapters, chosen), narrowed_registries
        )
        on_failure.pop_all()
        return adapted


def _open_in_torch(
    name: str,
    cache: Path,
    adapters: Path,
    *,
    robot: str,
    registry: str,
    limits: tuple[int, float] = (1, 600.0),
    unconstrained: bool = False,
    narrowed_registries: Mapping[str, str] = {},
) -> Planner:
    """A model of the manifest, or an adapter, in transformers.

    Raises `MissingDependencyError` without the extra `adapt`.
    """
    try:
        from dualbrain.adaptation.serving.transformers_planner import TorchConfig, TorchPlanner  # noqa: PLC0415  (torch is an extra)
    except ModuleNotFoundError as error:
        fix = "Install it with `pip install 'dualbrain[adapt]'`."
        raise MissingDependencyError(f"The package {error.name} of the extra `adapt`", fix=fix) from error
    threads, timeout_s = limits
    config = TorchConfig(threads=threads, timeout_s=timeout_s)
    full = without_constraints(FULL_PROMPT) if unconstrained else LOCAL_FULL_PROMPT
    if not is_adapter(name):
        if name not in (models := plain.planner_names()):
            known = (*models, *packaged_names(), f"{ADAPTER_PREFIX}ID", f"{ADAPTER_PREFIX}{CHAMPION}")
            raise UnknownNameError("planner in torch", name, known, owner="this installation")
        return TorchPlanner(
            name + TORCH_SUFFIX, AdapterStack(name, locate_weights(name, cache), ()), cache, full, config
        )
    stack = load_stack(resolve_folder(name, AdapterRegistry(adapters), robot), cache)
    require_same_prompt(stack.top_card)
    if robot:
        require_compatible(stack.top_card, robot, registry, narrowed_registries)
    short = short_prompt(scene_values=stack.top_card.scene_values)
    chosen = without_constraints(short) if unconstrained else short
    return TorchPlanner(
        proposal_author(name, stack), stack, cache, chosen, config, narrowed_registries=narrowed_registries
    )


def check_canaries(folder: Path, cache: Path, adapters: Path) -> str:
    """The fault in the answers of the adapter in `folder` to all its canaries, "" if there is none."""
    stack, config = load_stack(folder, cache), LlamaConfig(n_ctx=N_CTX)
    require_same_prompt(stack.top_card)
    planner = start_llama(stack, cache, config)
    try:
        return make_canary_check(planner, stack, cache, adapters, config)(planner, max_canaries=len(CANARY_QUESTIONS))
    finally:
        planner.close()


def local_runtime(folder: Path, cache: Path) -> str:
    """The runtime in which the adapter in `folder` serves here, as measurements name it; no process is started.

    Raises as `load_stack` does.
    """
    return runtime_name(base_path(load_stack(folder, cache), cache))


def start_llama(
    stack: AdapterStack, cache: Path, config: LlamaConfig, *, name: str = "", prompt_format: PromptFormat = SHORT_PROMPT
) -> LlamaPlanner:
    """A llama.cpp process with the model and the adapters of `stack`, prompted in `prompt_format`."""
    base, adapters = prepare_base(stack, cache), prepare_adapters(stack, cache)
    return LlamaPlanner(name or stack.base, base, config, prompt_format=prompt_format, adapters=adapters)


def make_canary_check(
    planner: LlamaPlanner, stack: AdapterStack, cache: Path, adapters: Path, config: LlamaConfig
) -> CanaryCheck:
    """The canary check of the topmost adapter of `stack` in the runtime of `planner`."""
    runtime = runtime_name(planner.model)
    config_hash = hash_metadata_files(stack.layers[-1].folder)[CONFIG_FILE]
    return CanaryCheck(
        adapters / CANARY_FOLDER,
        stack.top_card,
        runtime,
        lambda: start_llama(stack.without_top, cache, config),
        config_hash=config_hash,
    )


def planner_provenance(planner: Planner) -> dict[str, str]:
    """Prompt template of the planner that answers, and its adapter if it has one, for the episode record."""
    card: AdapterCard | None = getattr(planner, "card", None)
    return {"prompt": planner_template(planner)} | ({"adapter": card.id} if card else {})


def shadow_log_path(adapters: Path, adapter: str) -> Path:
    """The file that logs the shadow answers of a candidate."""
    return adapters / SHADOW_FOLDER / f"{adapter}.jsonl"


def proposal_author(name: str, stack: AdapterStack) -> str:
    """The author recorded for proposals: the name of a packaged adapter, else base and id."""
    short = name.removeprefix(ADAPTER_PREFIX)
    return short if short in packaged_names() else adapter_author(stack.top_card)
