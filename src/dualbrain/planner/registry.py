"""From a name, a GGUF file or an address to a planner."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urldefrag

from dualbrain.core.weights import MANIFEST, locate_weights
from dualbrain.errors import UnknownNameError
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.backends.openai_server import ServerConfig, ServerPlanner
from dualbrain.planner.protocol import Planner

DEFAULT_PLANNER = "qwen2.5-coder-1.5b-instruct"
SMALL_PLANNER = "smollm2-135m-instruct"
"""For tests; it does not plan unaided."""


UNKNOWN_NAME_KIND = "planner"
OTHER_FORMS_HINT = "a GGUF file or URL also works"
"""How an unknown name is told here and where more names are known."""


def planner_names() -> tuple[str, ...]:
    """Names of the language models in the manifest."""
    return tuple(name for name, file in MANIFEST.items() if file.filename.endswith(".gguf"))


def open_planner(
    name_or_url: str,
    cache: Path,
    *,
    key: str = "",
    dialect: str = "openai",
    threads: int = 1,
    timeout_s: float = 600.0,
    prompt_cache: Path | None = None,
) -> Planner:
    """The planner called `name_or_url`, ready to propose.

    A name of the manifest (its verified file in `cache`), the path of a GGUF file, or an address such as
    `http://localhost:8000/v1#model-name`, asked in `dialect` with `key`; `vllm+http://...` says which dialect.
    `prefixes`: see `LlamaConfig`. Raises `UnknownName`, `MissingPart`,
    `WrongHash`, `InvalidSetup`.
    """
    if "://" in name_or_url:
        told, plus, bare = name_or_url.partition("+http")
        dialect, address = (told, f"http{bare}") if plus and "://" not in told else (dialect, name_or_url)
        url, model = urldefrag(address)
        return ServerPlanner(
            ServerConfig(url=url, model=model or "default", key=key, dialect=dialect, timeout_s=timeout_s)
        )
    config = LlamaConfig(threads=threads, timeout_s=timeout_s, prompt_cache=prompt_cache)
    if name_or_url.endswith(".gguf"):
        return LlamaPlanner(Path(name_or_url).stem, Path(name_or_url), config)
    if name_or_url not in planner_names():
        raise UnknownNameError(
            UNKNOWN_NAME_KIND, name_or_url, planner_names(), owner=f"the manifest ({OTHER_FORMS_HINT})"
        )
    return LlamaPlanner(name_or_url, locate_weights(name_or_url, cache), config)
