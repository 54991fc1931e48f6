"""From a name to a planner: models and servers as the planner's room has them, and adapters on top."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from dualbrain.adaptation.adapters.card import CONFIG, IN_TORCH, AdapterCard, hashes_beside
from dualbrain.adaptation.adapters.compatibility import require_fit, require_prompt
from dualbrain.adaptation.adapters.naming import (
    CHAMPION,
    PREFIX,
    SHADOW,
    TORCH,
    folder_of,
    is_adapter,
    shadow_parts,
    without_engine,
)
from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.adapters.registry import Adapters
from dualbrain.adaptation.adapters.stacking import Stack, author_of, stack_of
from dualbrain.adaptation.serving.adapted_planner import AdaptedPlanner
from dualbrain.adaptation.serving.canary import SCENES, Watch
from dualbrain.adaptation.serving.gguf_cache import served, served_at, worn
from dualbrain.adaptation.serving.raw_completion import runtime_of
from dualbrain.adaptation.serving.shadow import Shadowed
from dualbrain.core.weights import locate
from dualbrain.errors import MissingPart, UnknownName
from dualbrain.planner import registry as plain
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.introspection import template_of
from dualbrain.planner.prompt.prompt_format import FULL, SHORT, Asking, unbound
from dualbrain.planner.protocol import Planner

N_CTX = 4096
"""Tokens of context: the longest short prompt with its exemplars and the longest answer fit."""
FORMS = (f"{PREFIX}ID", f"{PREFIX}{CHAMPION}", f"{SHADOW}ID@PLANNER", f"{TORCH}NAME")
"""Names that are not spelt out in a list of those known."""
CANARIES, SHADOWS = "canaries", "shadows"


def open_planner(
    name: str, cache: Path, *, adapters: Path, robot: str = "", registry: str = "", key: str = "",
    dialect: str = "openai", threads: int = 1, timeout_s: float = 600.0, prefixes: Path | None = None,
    narrowed: Mapping[str, str] = {},
) -> Planner:  # fmt: skip
    """The planner called `name`, ready to propose.

    `adapter:ID`, `adapter:champion`, the name of a packaged adapter, `shadow:ID@PLANNER` for a candidate that is asked
    too and heard by nobody, `transformers:NAME` for a model or an adapter in torch; all else as
    `planner.registry.open_planner` has it, unchanged. `adapters` is the folder of the registry. With `robot` (and the
    hash `registry` of its vocabulary) an adapter that was not taught them is refused before anything is started;
    `narrowed` names vocabularies that only narrow another one.
    Raises `InvalidSetup`, `UnknownName`, `MissingPart`, `WrongHash`, `NotItself`.
    """
    config = LlamaConfig(threads=threads, n_ctx=N_CTX, timeout_s=timeout_s)
    if name.startswith(SHADOW):
        candidate, serving = shadow_parts(name)
        with ExitStack() as unless_both:
            shadow = open_adapter(
                candidate, cache, adapters=adapters, robot=robot, registry=registry, config=config, narrowed=narrowed
            )
            unless_both.callback(shadow.close)
            served = open_planner(
                serving, cache, adapters=adapters, robot=robot, registry=registry, key=key, dialect=dialect,
                threads=threads, timeout_s=timeout_s, prefixes=prefixes, narrowed=narrowed,
            )  # fmt: skip
            unless_both.callback(served.close)
            both = Shadowed(served, shadow, shadow_log(adapters, shadow.card.id))
            unless_both.pop_all()
            return both
    if name.startswith(TORCH):
        within = (threads, timeout_s)
        return _in_torch(
            without_engine(name), cache, adapters, robot=robot, registry=registry, within=within, narrowed=narrowed
        )
    if is_adapter(name):
        return open_adapter(
            name, cache, adapters=adapters, robot=robot, registry=registry, config=config, narrowed=narrowed
        )
    try:
        return plain.open_planner(
            name, cache, key=key, dialect=dialect, threads=threads, timeout_s=timeout_s, prefixes=prefixes
        )
    except UnknownName as error:
        if error.kind != plain.KIND:  # of an address, which has a list of its own
            raise
        known = (*plain.planner_names(), *packaged_names(), *FORMS)
        raise UnknownName(plain.KIND, name, known, owner=f"this installation ({plain.ALSO})") from error


def unbinds(name: str) -> bool:
    """Whether `open_unbound` can open `name`: models that run here, with an adapter or without."""
    return is_adapter(core := without_engine(name)) or core in plain.planner_names()


def open_unbound(name: str, cache: Path, *, adapters: Path, robot: str = "", registry: str = "") -> Planner:
    """The planner called `name` with nothing that binds its answers: what it says then is what it knows.

    For measuring; a gate stands before the robot whatever binds a planner. `unbinds` tells for which names.
    """
    if name.startswith(TORCH):
        return _in_torch(without_engine(name), cache, adapters, robot=robot, registry=registry, free=True)
    if is_adapter(name):
        return open_adapter(name, cache, adapters=adapters, robot=robot, registry=registry, asking=unbound(SHORT))
    return LlamaPlanner(name, locate(name, cache), asking=unbound(FULL))


def open_adapter(
    name: str, cache: Path, *, adapters: Path, robot: str = "", registry: str = "", config: LlamaConfig | None = None,
    asking: Asking = SHORT, narrowed: Mapping[str, str] = {},
) -> AdaptedPlanner:  # fmt: skip
    """The adapter called `name` as a planner; its canary has been asked when this returns."""
    stack = stack_of(folder_of(name, Adapters(adapters), robot), cache)
    card = stack.top
    require_prompt(card)
    if robot:
        require_fit(card, robot, registry, narrowed)
    chosen = config or LlamaConfig(n_ctx=N_CTX)
    with ExitStack() as unless_itself:
        planner = wear(stack, cache, chosen, called=author(name, stack), asking=asking)
        unless_itself.callback(planner.close)
        adapted = AdaptedPlanner(planner, card, watch_of(planner, stack, cache, adapters, chosen), narrowed)
        unless_itself.pop_all()
        return adapted


def _in_torch(
    name: str, cache: Path, adapters: Path, *, robot: str, registry: str, within: tuple[int, float] = (1, 600.0),
    free: bool = False, narrowed: Mapping[str, str] = {},
) -> Planner:  # fmt: skip
    """A model of the manifest, or an adapter, in transformers; raises `MissingPart` without the extra."""
    try:
        from dualbrain.adaptation.serving.transformers_planner import TorchConfig, TorchPlanner  # noqa: PLC0415  (torch is an extra)
    except ModuleNotFoundError as error:
        fix = "Install it with `pip install 'dualbrain[adapt]'`."
        raise MissingPart(f"{error.name}, of the extra `adapt`,", fix=fix) from error
    threads, timeout_s = within
    config = TorchConfig(threads=threads, timeout_s=timeout_s)
    full, short = (unbound(FULL), unbound(SHORT)) if free else (FULL, SHORT)
    if not is_adapter(name):
        if name not in (models := plain.planner_names()):
            known = (*models, *packaged_names(), f"{PREFIX}ID", f"{PREFIX}{CHAMPION}")
            raise UnknownName("planner in torch", name, known, owner="this installation")
        return TorchPlanner(name + IN_TORCH, Stack(name, locate(name, cache), ()), cache, full, config)
    stack = stack_of(folder_of(name, Adapters(adapters), robot), cache)
    require_prompt(stack.top)
    if robot:
        require_fit(stack.top, robot, registry, narrowed)
    return TorchPlanner(author(name, stack), stack, cache, short, config, narrowed=narrowed)


def examine(folder: Path, cache: Path, adapters: Path) -> str:
    """What is wrong with the answers of the adapter in `folder` to all its canaries, "" if nothing is."""
    stack, config = stack_of(folder, cache), LlamaConfig(n_ctx=N_CTX)
    require_prompt(stack.top)
    planner = wear(stack, cache, config)
    try:
        return watch_of(planner, stack, cache, adapters, config)(planner, most=len(SCENES))
    finally:
        planner.close()


def runtime_here(folder: Path, cache: Path) -> str:
    """The runtime in which the adapter in `folder` serves here, as a measurement names it; nothing is started.

    Raises as `stack_of` does.
    """
    return runtime_of(served_at(stack_of(folder, cache), cache))


def wear(stack: Stack, cache: Path, config: LlamaConfig, *, called: str = "", asking: Asking = SHORT) -> LlamaPlanner:
    """A process of the stack's model with its adapters, asked by `asking`."""
    base, adapters = served(stack, cache), worn(stack, cache)
    return LlamaPlanner(called or stack.base, base, config, asking=asking, adapters=adapters)


def watch_of(planner: LlamaPlanner, stack: Stack, cache: Path, adapters: Path, config: LlamaConfig) -> Watch:
    """The canaries of the adapter on top, in the runtime of `planner`, which wears it."""
    runtime = runtime_of(planner.model)
    worn_as = hashes_beside(stack.layers[-1].folder)[CONFIG]
    return Watch(adapters / CANARIES, stack.top, runtime, lambda: wear(stack.below, cache, config), worn=worn_as)


def origin(planner: Planner) -> dict[str, str]:
    """Prompt template and adapter of the planner that answers, for the record; empty for one without an adapter."""
    card: AdapterCard | None = getattr(planner, "card", None)
    return {"prompt": template_of(planner), "adapter": card.id} if card else {}


def shadow_log(adapters: Path, adapter: str) -> Path:
    """Where the answers of a candidate in the shadow are written down."""
    return adapters / SHADOWS / f"{adapter}.jsonl"


def author(name: str, stack: Stack) -> str:
    """What is recorded as the author: the name of a packaged adapter, else base and id."""
    short = name.removeprefix(PREFIX)
    return short if short in packaged_names() else author_of(stack.top)
